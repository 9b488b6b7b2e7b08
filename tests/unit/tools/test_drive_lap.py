"""A lap as an operator drives it: from the order to arm to the end that the tracker reports."""

import asyncio

from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import Mailbox
from monstertruck_schemas import topics
from monstertruck_schemas.event import Event, Severity
from monstertruck_schemas.plan import TrackerState
from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.simulation.operator import drive_lap


class Robot:
    """Its tracker reports the end of the lap before for a moment, and drives two seconds."""

    def __init__(self, clock: VirtualClock):
        self._clock = clock
        self._boxes: dict[str, Mailbox] = {}
        self.orders: list[str] = []

    def subscribe(self, topic, delivery):
        return self._boxes.setdefault(topic.name, Mailbox(delivery))

    async def arm(self, *, hold=False):
        self.orders.append("arm")
        self._driving = asyncio.create_task(self._drive())

    async def disarm(self):
        self.orders.append("disarm")
        await self._driving

    async def _drive(self):
        for tenth in range(23):
            await self._clock.sleep(0.1)
            ended = tenth < 2 or tenth > 20
            outcome, along = (Reason.GOAL_REACHED, 3.0) if ended else (Reason.DRIVING, tenth * 0.1)
            now = self._clock.now()
            header = {"stamp": now, "received": now, "seq": tenth, "path": "loop", "length": 3.0, "heading_error": 0.0}
            state = TrackerState(**header, along=along, cross_track=0.0, outcome=outcome)
            self._boxes[topics.TRACKER.name].put(state)


def test_the_end_of_the_lap_before_is_not_that_of_this_one():
    async def main(clock: VirtualClock):
        robot = Robot(clock)
        lap = await drive_lap(robot, clock)
        assert lap.outcome is Reason.GOAL_REACHED
        assert round((lap.end - lap.start) / SECOND, 1) == 2.2
        assert robot.orders == ["arm", "disarm"]

    run_virtual(main)


class RobotFarFromItsPath(Robot):
    """Its tracker reports that the path is lost, from the first step on; it is disarmed after a while."""

    async def _drive(self):
        for tenth in range(40):
            await self._clock.sleep(0.1)
            now = self._clock.now()
            header = {"stamp": now, "received": now, "seq": tenth, "path": "loop", "length": 3.0, "heading_error": 0.0}
            state = TrackerState(**header, along=0.0, cross_track=4.0, outcome=Reason.PATH_LOST)
            self._boxes[topics.TRACKER.name].put(state)
            if tenth == 1:
                event = {"stamp": now, "received": now, "seq": 1, "severity": Severity.WARNING, "source": "track"}
                text = "path 'loop' is 4.00 m from the robot"
                self._boxes[topics.EVENT.name].put(Event(**event, reason=Reason.PATH_LOST, text=text))


def test_a_path_metres_away_ends_at_once_with_where_it_is_and_is_not_armed_for_again():
    async def main(clock: VirtualClock):
        robot = RobotFarFromItsPath(clock)
        begun = clock.now()
        lap = await drive_lap(robot, clock)
        assert (lap.outcome, lap.armed_again) == (Reason.PATH_LOST, 0)
        assert lap.text == "path 'loop' is 4.00 m from the robot"
        assert clock.now() - begun < 5 * SECOND
        assert robot.orders == ["arm", "disarm"]

    run_virtual(main)
