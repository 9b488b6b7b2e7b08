"""What a test stand sees of the robot is recorded, and nothing in the robot can read it."""

import asyncio
from pathlib import Path

import pytest

from monstertruck_runtime import wire
from monstertruck_runtime.clock import SECOND, WallClock
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import StandPose
from monstertruck_schemas.topics import BY_NAME, EVENT, STAND_POSE, TOPICS, Writer
from monstertruckd.bus.intake import Refusals, StandIntake
from monstertruckd.bus.local import Bus
from monstertruckd.daemon import Daemon
from monstertruckd.tools.simulation.config import load_simulated

STAND = Path(__file__).resolve().parents[3] / "configs" / "robots" / "skid_stand.yaml"
POSE = StandPose(
    stamp=5,
    received=7,
    seq=1,
    frame="map",
    pose=Pose2D(x=0.1, y=-0.2, yaw=0.3),
    observer="overhead",
    position_sigma=0.001,
    heading_sigma=0.01,
)


def test_there_is_one_such_topic_and_it_is_logged():
    assert [topic for topic in TOPICS if topic.writer is Writer.STAND] == [STAND_POSE]
    assert STAND_POSE.logged
    assert STAND_POSE.inward
    assert BY_NAME["stand/pose"].key("rover") == "mt/stand/sensor/pose_rover"


def test_no_part_of_a_robot_gets_a_read_end():
    bus = Bus(WallClock())
    with pytest.raises(RuntimeError, match="only recorded: no part of the robot"):
        bus.subscribe(STAND_POSE, latest())
    with pytest.raises(RuntimeError, match="only recorded: no part of the robot"):
        bus.listen(STAND_POSE, lambda _: None)
    for writer in Writer:
        with pytest.raises(RuntimeError):
            bus.publisher(STAND_POSE, writer)


def test_a_whole_daemon_has_no_reader_of_it():
    daemon = Daemon(load_simulated(STAND), WallClock(), seed=1)
    ends = daemon.bus._ends[STAND_POSE.name]
    assert (ends.listeners, ends.mailboxes) == ([], ())


def test_what_a_stand_sees_reaches_the_taps_with_the_time_it_arrived():
    bus, seen = Bus(WallClock()), []
    bus.tap(lambda topic, message, data, at: seen.append((topic, message, data)), [STAND_POSE])
    bus.put_stand(STAND_POSE, POSE)
    ((topic, message, data),) = seen
    assert (topic, message.stamp, message.pose) == (STAND_POSE, 5, POSE.pose)
    assert message.received > 7
    assert wire.decode(STAND_POSE, data) == message
    with pytest.raises(RuntimeError, match="not by a stand"):
        bus.put_stand(EVENT, POSE)


def test_poses_from_outside_are_bounded_in_size_and_rate_and_must_be_poses():
    async def main() -> None:
        clock = WallClock()
        bus, seen = Bus(clock), []
        bus.tap(lambda topic, message, data, at: seen.append(message), [STAND_POSE])
        events = bus.subscribe(EVENT, fifo(10))
        stand_intake = StandIntake(bus, clock, lambda act: act(), Refusals(bus, clock, "zenoh"))
        data = wire.encode(STAND_POSE, POSE)
        stand_intake.take(len(data), lambda: data)
        stand_intake.take(5000, lambda: data)
        await asyncio.sleep(0.02)
        assert len(seen) == 1
        assert [event.reason for event in events.drain()] == [Reason.BAD_INPUT]
        stand_intake.take(4, lambda: b"junk")
        begin = clock.now()
        for _ in range(300):
            stand_intake.take(len(data), lambda: data)
            await asyncio.sleep(0)
        await asyncio.sleep(0.02)
        assert 50 <= len(seen) <= StandIntake.RATE * (1 + (clock.now() - begin) / SECOND) + 5
        stand_intake.close()

    asyncio.run(main())
