"""Where on the common grid the services of the whole truck stand."""

from collections import defaultdict

import pytest

from monstertruck_runtime.clock import MILLISECOND, VirtualClock, run_virtual
from monstertruck_runtime.schedule import AHEAD, ESTIMATES, IN_THREADS
from monstertruck_schemas import topics
from monstertruckd.config.validate import load_config
from monstertruckd.sim.config import SimulatedTruckConfig
from monstertruckd.sim.faults_drill import with_overlay
from monstertruckd.sim.rig import VirtualRig
from tests.daemon.goal_kit import CONFIGS

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(60)]

PLACES = {
    topics.ODOMETRY: (50, ESTIMATES),
    topics.TRACKER: (20, AHEAD),
    topics.TRANSFORMS: (10, AHEAD),
    topics.CMD_STEERING: (50, 0),
    topics.LINK: (2, IN_THREADS),
    topics.HOST: (1, IN_THREADS),
}
"""Rate, and ns before the multiples of its period."""


def test_estimates_come_first_then_who_uses_them_then_the_gate_then_threads():
    config = load_config(CONFIGS / "full.yaml", SimulatedTruckConfig)[0]
    found = defaultdict(list)

    async def main(clock: VirtualClock) -> None:
        rig = VirtualRig(with_overlay(config, {"recorder": None, "map": None}), clock)
        async with rig.running():
            await clock.sleep(4.0)
            tap = rig.bus.tap(lambda topic, message, *_: found[topic].append(message.stamp), PLACES)
            await clock.sleep(2.0)
            tap.close()

    run_virtual(main)
    for topic, (rate, ahead) in PLACES.items():
        period = 1000 * MILLISECOND // rate
        late = [(stamp + ahead) % period for stamp in found[topic]]
        assert late, topic.name
        assert max(late) < MILLISECOND // 10, topic.name
