"""Where on the common grid the services of the whole truck stand."""

from collections import defaultdict

import pytest

from monstertruck_runtime.clock import MILLISECOND, Lead, VirtualClock, run_virtual
from monstertruck_schemas import topics
from monstertruckd.bus.outgoing import BEHIND
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.virtual_rig import VirtualRig
from tests.daemon.goal_kit import CONFIGS

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(60)]

PLACES = {
    topics.ODOMETRY: (50, Lead.ESTIMATES),
    topics.TRACKER: (20, Lead.BEFORE_GATE),
    topics.TRANSFORMS: (10, Lead.BEFORE_GATE),
    topics.CMD_STEERING: (50, 0),
    topics.LINK: (2, Lead.IN_THREADS),
    topics.HOST: (1, Lead.IN_THREADS),
}
"""Rate, and ns before the multiples of its period."""


ASKED = {topics.STEERING: (20, 1), topics.STABILISER: (25, 4), topics.DRIVES[0]: (20, 19)}
"""Rate, and the ms that the answer of the device takes: the drive's two exchanges take their time on its line."""


def seen(wanted, instant):
    """``instant`` of message and present time, for the messages of two seconds that taps get, by topic."""
    config = load_config(CONFIGS / "full.yaml", SimulatedTruckConfig)[0]
    found = defaultdict(list)

    async def main(clock: VirtualClock) -> None:
        rig = VirtualRig(with_overlay(config, {"recorder": None, "map": None}), clock)
        async with rig.running():
            await clock.sleep(4.0)
            tap = rig.bus.tap(lambda topic, message, *_: found[topic].append(instant(message, clock.now())), wanted)
            await clock.sleep(2.0)
            tap.close()

    run_virtual(main)
    return found


def test_devices_are_asked_before_the_estimates_are_made():
    found = seen(ASKED, lambda message, _: message.received)
    for topic, (rate, takes) in ASKED.items():
        period = 1000 * MILLISECOND // rate
        took = sorted((instant + Lead.POLLING) % period for instant in found[topic])
        assert len(took) == pytest.approx(2 * rate, abs=1), topic.name
        assert (takes - 1) * MILLISECOND <= took[len(took) // 2] <= takes * MILLISECOND, topic.name
        assert took[0] >= took[len(took) // 2] - MILLISECOND // 10, topic.name


def test_estimates_come_first_then_who_uses_them_then_the_gate_then_threads():
    found = seen(PLACES, lambda message, _: message.stamp)
    for topic, (rate, ahead) in PLACES.items():
        period = 1000 * MILLISECOND // rate
        late = [(stamp + ahead) % period for stamp in found[topic]]
        assert late, topic.name
        assert max(late) < MILLISECOND // 10, topic.name


def test_what_leaves_leaves_in_rows_behind_the_gate():
    wanted = (topics.ODOMETRY, topics.SCAN, topics.CMD_DRIVES[0], topics.HEALTH)
    found = seen(wanted, lambda _, now: now)
    # Retained messages are reported at once at the begin, what waits at the end.
    begin, end = min(map(min, found.values())), max(map(max, found.values()))
    for topic in wanted:
        late = [(now - BEHIND) % (40 * MILLISECOND) for now in found[topic] if begin < now < end]
        assert late, topic.name
        assert max(late) < MILLISECOND // 10, topic.name
