"""Moves of the wizards: what ends them early has its reason, and says what to do."""

import asyncio
from contextlib import suppress
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from monstertruck_kinematics.truck import DriveTrain
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import NoAnswerError, RequestRefusedError
from monstertruck_runtime.mailbox import Mailbox
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import GateMode, GateState
from monstertruckd.tools.calibrate import motion
from monstertruckd.tools.calibrate.steps import MoveStep

STEP = MoveStep("run", speed=0.2, front=0.0, rear=0.0, metres=1.0)


def gate_state(reasons: tuple[Reason, ...], mode: GateMode) -> GateState:
    return GateState(stamp=0, received=0, seq=0, mode=mode, nonce="n", speed_limit=0.0, reasons=reasons)


def stopped(*reasons: Reason, mode: GateMode = GateMode.DISARMED) -> RequestRefusedError:
    run = motion._Run(None, SimpleNamespace(now=lambda: 0), (), {})
    run.state = gate_state(reasons, mode)
    run._truck = SimpleNamespace(source="wizard")
    with pytest.raises(RequestRefusedError) as refused:
        run._check()
    return refused.value


def test_a_stop_has_the_reason_of_the_gate():
    assert stopped(Reason.DISARMED, Reason.OBSTACLE_STOP).refusal is Reason.OBSTACLE_STOP
    assert str(stopped(Reason.DISARMED)) == "stopped by the gate: the robot is disarmed"


def test_an_expired_lease_says_what_to_do():
    error = stopped(Reason.LEASE_EXPIRED)
    assert str(stopped(mode=GateMode.ARMED)) == str(error), "armed, and nobody drives: the lease is gone already"
    assert error.refusal is Reason.LEASE_EXPIRED
    assert str(error).startswith(
        "stopped by the gate: no fresh drive request within its lease; drive requests arrived too late:"
    )
    assert "repeat it (nothing was saved)" in str(error)


def test_a_silent_device_says_what_to_do_once():
    error = stopped(Reason.DRIVE_STALE, Reason.SCAN_STALE)
    assert str(error).startswith(
        "stopped by the gate: no fresh drive feedback, no fresh lidar scan; a device was silent"
    )
    assert str(error).count("repeat the command") == 1
    assert ";" not in str(stopped(Reason.OBSTACLE_STOP))


@pytest.mark.parametrize(
    ("held", "kind", "said"),
    [
        (
            (Reason.OBSTACLE_STOP,),
            RequestRefusedError,
            "run: no progress for 3 s (obstacle within the stopping distance)",
        ),
        ((), NoAnswerError, "run: no progress for 3 s (the robot is driving)"),
    ],
)
def test_a_run_that_is_held_ends_by_what_holds_it(held: tuple[Reason, ...], kind: type[Exception], said: str):
    async def main(clock):
        mover = motion.Mover(None, clock, SimpleNamespace(drivetrain=None))
        record = SimpleNamespace(left=0, distance=lambda _: 0.0)

        async def hold(*_: float) -> None:
            await clock.sleep(motion.REQUEST_PERIOD)

        run = SimpleNamespace(track=record, state=gate_state(held, GateMode.DRIVING), hold=hold, robot_time=0)
        await mover._drive(run, STEP, lambda *_: None)

    with pytest.raises(kind) as ended:
        run_virtual(main)
    assert str(ended.value) == said
    assert getattr(ended.value, "refusal", Reason.TIMEOUT) is (held[0] if held else Reason.TIMEOUT)


class HinderedTruck:
    """Drives as requested until it comes past a place: there its gate stops it, as often as listed.

    Args:
        clock: time.
        stops: place, m from the start in the direction ahead, reason, and the seconds until that has passed.
        booted: seconds by which its own clock is behind.
    """

    source = "wizard"

    def __init__(self, clock: VirtualClock, *stops: tuple[float, Reason, float], booted: float = 0.0) -> None:
        self.x = 0.0
        self._booted = round(booted * SECOND)
        self.turns: list[float] = []
        """Places where it changed its direction."""
        self._clock = clock
        self._stops = list(stops)
        self._boxes: dict[str, list[Mailbox[Any]]] = {}
        self._mode, self._reason, self._until, self._speed = GateMode.DISARMED, Reason.DISARMED, 0, 0.0
        self._way = 0.0

    def subscribe(self, topic, delivery):
        box = Mailbox(delivery)
        self._boxes.setdefault(topic.name, []).append(box)
        return box

    async def arm(self, *, hold, calibrates):
        assert hold, "while its requests are on their way a planner would drive"
        if self._reasons():
            raise RequestRefusedError(self._reasons()[0])
        self._mode = GateMode.DRIVING

    async def disarm(self):
        self._mode = GateMode.DISARMED

    async def drive(self, speed, front, rear=0.0, lease=0.3):
        if speed and self._mode is GateMode.DRIVING and speed != self._way:
            self.turns.append(self.x)
            self._way = speed
        self._speed = speed

    def _reasons(self):
        return (self._reason,) if self._clock.now() < self._until else ()

    async def publish(self) -> None:
        """Go on and tell, every 20 ms."""
        drivetrain = DriveTrain()
        while True:
            await self._clock.sleep(0.02)
            speed = self._speed if self._mode is GateMode.DRIVING else 0.0
            self.x += 0.02 * speed
            if self._stops and speed > 0.0 and self.x > self._stops[0][0]:
                _, self._reason, seconds = self._stops.pop(0)
                self._mode, self._until = GateMode.DISARMED, self._clock.now() + round(seconds * SECOND)
            now = self._clock.now() - self._booted
            position = drivetrain.motor_angle(self.x)
            state = gate_state(self._reasons(), self._mode).model_copy(update={"holder": self.source, "stamp": now})
            for box in self._boxes.get(topics.GATE.name, ()):
                box.put(state)
            for box in self._boxes.get(topics.DRIVE.name, ()):
                box.put(SimpleNamespace(stamp=now, position=position, current=None))


def hindered(step: MoveStep, *stops: tuple[float, Reason, float]) -> tuple[HinderedTruck, Any, list[str]]:
    """Truck, record or error, and what was said."""
    said: list[str] = []

    async def main(clock: VirtualClock):
        truck = HinderedTruck(clock, *stops)
        publishing = asyncio.create_task(truck.publish())
        try:
            mover = motion.Mover(truck, clock, SimpleNamespace(drivetrain=DriveTrain()))
            try:
                return truck, await mover.move(step, lambda *_: None, said.append), said
            except RequestRefusedError as error:
                return truck, error, said
        finally:
            publishing.cancel()
            with suppress(asyncio.CancelledError):
                await publishing

    return run_virtual(main)


def test_after_a_stop_that_passed_it_drives_back_and_once_more():
    truck, record, said = hindered(STEP, (0.4, Reason.SCAN_STALE, 0.3), (0.7, Reason.LEASE_EXPIRED, 0.1))
    assert truck.turns == pytest.approx([0.0, 0.4, 0.0, 0.7, 0.0], abs=0.05)
    assert truck.x == pytest.approx(1.0, abs=0.05)
    assert record.distance(DriveTrain()) == pytest.approx(1.0, abs=0.05), "of the last one alone"
    assert said == [
        "run: no fresh lidar scan; returning to the start for another attempt",
        "run: no fresh drive request within its lease; returning to the start for another attempt",
    ]


def test_one_that_lasts_or_comes_a_third_time_ends_the_move_by_its_reason():
    _, error, said = hindered(STEP, (0.4, Reason.SCAN_STALE, 60.0))
    assert (error.refusal, said) == (Reason.SCAN_STALE, [])
    assert str(error).startswith("stopped by the gate: no fresh lidar scan")
    _, error, said = hindered(STEP, *3 * [(0.4, Reason.LEASE_EXPIRED, 0.1)])
    assert (error.refusal, len(said)) == (Reason.LEASE_EXPIRED, 2)
    _, error, said = hindered(STEP, (0.4, Reason.OBSTACLE_STOP, 0.1))
    assert (error.refusal, said) == (Reason.OBSTACLE_STOP, []), "that is the operator's to see"


def test_a_move_that_is_measured_from_a_mark_begins_anew_only_there():
    marked = replace(STEP, marked=True)
    _, error, said = hindered(marked, (0.4, Reason.LEASE_EXPIRED, 0.1))
    assert (error.refusal, said) == (Reason.LEASE_EXPIRED, [])
    truck, _, said = hindered(marked, (0.0, Reason.LEASE_EXPIRED, 0.1))
    assert len(said) == 1
    assert truck.x == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("booted", [-1000.0, 0.0, 1000.0])
def test_when_it_set_off_is_by_the_robots_clock(booted: float):
    async def main(clock: VirtualClock) -> None:
        truck = HinderedTruck(clock, booted=booted)
        publishing = asyncio.create_task(truck.publish())
        mover = motion.Mover(truck, clock, SimpleNamespace(drivetrain=DriveTrain()))
        record = await mover.move(STEP, lambda *_: None)
        publishing.cancel()
        at_rest = [reading.position for reading in record.drive if reading.stamp < record.left]
        moving = [reading.position for reading in record.drive if record.left < reading.stamp < record.arrived]
        assert len(at_rest) > 5
        assert set(at_rest) == {0.0}
        assert len(set(moving)) > 100

    run_virtual(main, start=round(5000 * SECOND))


@pytest.mark.parametrize("place", [0.5, 1.0])
def test_a_robot_that_vanishes_is_not_said_to_be_stuck_or_restless(place: float):
    async def main(clock: VirtualClock) -> None:
        truck = HinderedTruck(clock)
        publishing = asyncio.create_task(truck.publish())
        mover = motion.Mover(truck, clock, SimpleNamespace(drivetrain=DriveTrain()))
        moving = asyncio.create_task(mover.move(STEP, lambda *_: None))
        while truck.x < place - 1e-6:
            await clock.sleep(0.02)
        publishing.cancel()
        with pytest.raises(NoAnswerError, match=r"^the robot has been silent for 2 s"):
            await moving

    run_virtual(main)


def test_a_weaving_move_goes_straight_back():
    weaving = replace(STEP, front=0.3, rear=-0.3, weave=(1.0,))
    assert weaving.back(0.4) == replace(STEP, name="run, back", speed=-0.2, metres=0.4)
    assert replace(STEP, front=0.3).back(0.4) == replace(STEP, name="run, back", speed=-0.2, metres=0.4, front=0.3)
