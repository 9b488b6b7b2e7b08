"""Other robots: heard over Zenoh, known by name, with the time of receipt by this robot's clock."""

import asyncio
from pathlib import Path

import pytest

from monstertruck_runtime.clock import SECOND, VirtualClock, WallClock, run_virtual
from monstertruck_runtime.errors import ConfigError, NoAnswerError, NotFoundError
from monstertruck_runtime.mailbox import latest
from monstertruck_schemas.topics import GATE, PEERS, POSE, Writer
from monstertruckd.bus import peers
from monstertruckd.bus.local import Bus
from monstertruckd.bus.peers import PeerService, PeerSubscriber
from monstertruckd.bus.zenoh_config import PeerConfig
from monstertruckd.tools.simulation.config import load_simulated
from tests.bus_kit import free_endpoint, gate_state, odometry, running_robot

FLEET = Path(__file__).resolve().parents[3] / "configs" / "fleet"


def test_what_was_heard_is_published_at_a_rate_with_when_it_came():
    async def main(clock: VirtualClock) -> None:
        bus = Bus(clock)
        service = PeerService(clock, bus.publisher(PEERS, Writer.ESTIMATION))
        with bus.subscribe(PEERS, latest()) as heard:
            task = asyncio.create_task(service.run(lambda: None))
            await clock.sleep(0.15)
            assert heard.latest is not None
            assert heard.latest.peers == ()
            service.hear("ann", odometry(1, x=1.0))
            at = clock.now()
            service.hear("bob", odometry(1, x=5.0))
            await clock.sleep(1.0)
            ann, bob = heard.latest.peers
            assert (ann.robot, ann.pose.x, ann.heard) == ("ann", 1.0, at)
            assert bob.pose.x == 5.0
            assert (heard.latest.stamp - ann.heard) / SECOND == pytest.approx(1.0, abs=0.1)
            task.cancel()
            await asyncio.wait([task])

    run_virtual(main)


async def test_another_robot_is_heard_over_its_own_endpoint():
    clock = WallClock()
    bus = Bus(clock)
    service = PeerService(clock, bus.publisher(PEERS, Writer.ESTIMATION))
    async with running_robot(robot="ann") as ann:
        out = ann.bus.publisher(POSE, Writer.ESTIMATION)
        ready = asyncio.Event()
        subscriber = PeerSubscriber("ann", PeerConfig(endpoint=ann.endpoint), clock, service)
        tasks = [asyncio.create_task(subscriber.run(ready.set)), asyncio.create_task(service.run(lambda: None))]
        try:
            with bus.subscribe(PEERS, latest()) as heard:
                async with asyncio.timeout(20):
                    while heard.latest is None or not heard.latest.peers:
                        out.put(odometry(out.next_seq(), x=3.0))
                        await asyncio.sleep(0.05)
                (peer,) = heard.latest.peers
                assert (peer.robot, peer.pose.x) == ("ann", 3.0)
                assert 0 <= clock.now() - peer.heard < 5 * SECOND
                assert ready.is_set()
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.wait(tasks)


async def test_a_robot_that_is_not_there_is_an_error_that_is_tried_again():
    clock = WallClock()
    service = PeerService(clock, Bus(clock).publisher(PEERS, Writer.ESTIMATION))
    with pytest.raises(NotFoundError):
        await PeerSubscriber("ann", PeerConfig(endpoint=free_endpoint()), clock, service).run(lambda: None)


@pytest.mark.parametrize(
    ("name", "error", "said"),
    [
        ("anna", NotFoundError, "no robot 'anna' at .*; found: ann"),
        ("ann", NoAnswerError, "robot 'ann' at .* has published no pose for 0.2 s"),
    ],
)
async def test_a_robot_of_another_name_or_without_a_pose_is_not_ready(
    name: str, error: type[Exception], said: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(peers, "SILENT", 0.2)
    clock = WallClock()
    service = PeerService(clock, Bus(clock).publisher(PEERS, Writer.ESTIMATION))
    async with running_robot(robot="ann") as ann:
        ann.bus.publisher(GATE, Writer.GATE).put(gate_state(1))
        subscriber = PeerSubscriber(name, PeerConfig(endpoint=ann.endpoint), clock, service)
        with pytest.raises(error, match=said):
            await subscriber.run(lambda: pytest.fail("nothing was heard"))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("peers: { second: { endpoint: tcp/127.0.0.1:1 } }", "peers.second: expected other robots than this one"),
        ("behaviours: { follow: { leader: bob } }", "behaviours.follow.leader bob: expected one of peers"),
    ],
)
def test_peers_that_make_no_sense_are_refused(tmp_path: Path, text: str, said: str):
    file = tmp_path / "bad.yaml"
    file.write_text(f"include: {FLEET / 'second.yaml'}\nversion: 2\n{text}\n")
    with pytest.raises(ConfigError) as caught:
        load_simulated(file)
    assert said in str(caught.value)
