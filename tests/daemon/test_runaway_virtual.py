"""A motor that does not obey, in the whole daemon on the virtual clock, judged by the simulated world."""

from itertools import product

import pytest

from benchmarks.runaway import READS_NOTHING, READS_REST
from benchmarks.runaway_parts.trial import Moment, Outcome, Robot, run, with_speeds
from monstertruck_schemas.state import GateMode
from tests.long_kit import mostly_long

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(120)]

DEMO, FULL = Robot("demo"), Robot("full")
ACKERMANN, SKID_STEER = Robot("robots/ackermann"), Robot("robots/skid_steer")
TRICYCLE = Robot("robots/tricycle")
STEPPERS = Robot("robots/skid_stand", role="wheels", speed=0.06, creep=30.0, run=45.0)
NAMES = {DEMO: "demo", FULL: "full", ACKERMANN: "ackermann", SKID_STEER: "skid_steer", STEPPERS: "steppers"}
IGNORES, CREEPS = "runaway ignore", "runaway creep CREEP"


def tried(robot: Robot, fault: str, moment: Moment, *, line: bool = False) -> Outcome:
    return run(robot, with_speeds(robot, fault), moment, line=line)


def is_found(outcome: Outcome, within: float = 0.5) -> None:
    assert outcome.event is not None
    assert outcome.event <= within
    assert outcome.boxed == outcome.event, "with a black box at once"
    assert outcome.safe is not None
    assert outcome.safe - outcome.event <= 1.0
    assert outcome.mode is GateMode.ESTOPPED


@pytest.mark.parametrize(
    ("robot", "line"),
    mostly_long(product(NAMES, (False, True)), {(DEMO, False), (DEMO, True), (SKID_STEER, False), (STEPPERS, False)}),
    ids=[f"{name}-{line}" for name in NAMES.values() for line in ("no line", "line")],
)
def test_a_drive_that_ignores_the_emergency_stop_is_found_and_loses_its_power_stage(robot: Robot, line: bool):
    outcome = tried(robot, IGNORES, Moment.ESTOP, line=line)
    assert outcome.travelled <= 0.3
    assert outcome.stopping[0] == pytest.approx(0.0, abs=0.02)
    if outcome.event is None:  # the line fell with the emergency stop, and stopped the motor by itself
        assert line
        assert outcome.safe is not None
        assert outcome.safe <= 0.5
        return
    is_found(outcome)
    assert not outcome.powered
    assert outcome.stopping[1] >= outcome.event - 0.05, "until it stands"


@pytest.mark.parametrize(
    ("robot", "moment"),
    mostly_long(
        product((DEMO, SKID_STEER, STEPPERS), (Moment.STOP, Moment.DISARM, Moment.LEASE, Moment.ARMED)),
        {(DEMO, Moment.LEASE), (DEMO, Moment.ARMED), (SKID_STEER, Moment.STOP), (STEPPERS, Moment.DISARM)},
    ),
    ids=lambda value: NAMES.get(value, value),
)
def test_a_drive_that_creeps_is_found_in_every_mode(robot: Robot, moment: Moment):
    outcome = tried(robot, CREEPS, moment)
    is_found(outcome, 0.5 + (0.25 if moment is Moment.LEASE else 0.0))
    assert outcome.travelled <= 0.15


@pytest.mark.parametrize("order", [Moment.STOP, Moment.DISARM])
def test_stop_and_disarm_are_answered_only_when_the_truck_stands(order: Moment):
    outcome = tried(DEMO, CREEPS, order)
    assert outcome.answer.startswith("estopped after")
    assert float(outcome.answer.split()[-2]) >= outcome.stopping[1] - 0.1


@pytest.mark.parametrize(
    ("fault", "moment"),
    [
        ("runaway run RUN", Moment.DRIVING),
        ("runaway run BACK", Moment.DRIVING),
        ("runaway reverse", Moment.DRIVING),
        (READS_REST["drive"] + CREEPS, Moment.ARMED),
        (READS_REST["drive"] + CREEPS, Moment.ESTOP),
    ],
)
def test_faster_than_ordered_the_other_way_and_a_velocity_that_lies_are_found(fault: str, moment: Moment):
    is_found(tried(DEMO, fault, moment))


@pytest.mark.parametrize(
    ("robot", "moment"),
    mostly_long(
        product((DEMO, TRICYCLE), (Moment.ARMED, Moment.ESTOP)), {(DEMO, Moment.ARMED), (TRICYCLE, Moment.ESTOP)}
    ),
    ids=lambda value: {DEMO: "scans", TRICYCLE: "scans and free wheels"}.get(value, value),
)
def test_a_drive_that_reads_rest_while_it_turns_is_found_by_what_does_not_come_from_it(robot: Robot, moment: Moment):
    outcome = tried(robot, READS_NOTHING["drive"] + CREEPS, moment)
    is_found(outcome)
    assert not outcome.powered
    assert outcome.travelled <= 0.12


def test_a_power_stage_that_is_off_and_turns_the_motor_all_the_same_is_found_and_stopped_by_the_line():
    is_found(tried(DEMO, "runaway run CREEP line", Moment.DISARMED, line=True))


def test_a_motor_that_nothing_stops_goes_on_stopping_and_the_order_says_so():
    outcome = tried(DEMO, "runaway ignore supply", Moment.DISARM)
    assert outcome.event is not None
    assert outcome.event <= 0.5
    assert outcome.safe is None
    assert "standstill is not confirmed after 4 s" in outcome.answer
    assert "a motor turns without a command" in outcome.answer
    assert outcome.stopping[1] >= 2.9


def test_a_drive_that_lies_altogether_is_found_by_the_free_wheels():
    lies = READS_REST["drive"] + "signal position_actual frozen; "
    outcome = tried(TRICYCLE, lies + "runaway run CREEP", Moment.ARMED)
    is_found(outcome, 1.0)


@pytest.mark.parametrize(
    ("robot", "fault"),
    mostly_long(
        product((DEMO, FULL, SKID_STEER, STEPPERS), (IGNORES, CREEPS, "runaway run RUN")),
        {(DEMO, IGNORES), (FULL, "runaway run RUN"), (SKID_STEER, CREEPS), (STEPPERS, IGNORES)},
    ),
    ids=lambda value: NAMES.get(value, value),
)
def test_the_daemons_end_leaves_no_power_stage_on(robot: Robot, fault: str):
    outcome = tried(robot, fault, Moment.END)
    assert not outcome.powered
    assert outcome.safe is not None
    assert outcome.travelled <= 0.3


@pytest.mark.parametrize(
    ("robot", "moment"),
    mostly_long(
        product(NAMES, (Moment.ESTOP, Moment.DISARM, Moment.LEASE, Moment.DRIVING, Moment.END)),
        {
            (DEMO, Moment.END),
            (FULL, Moment.DRIVING),
            (ACKERMANN, Moment.DISARM),
            (SKID_STEER, Moment.ESTOP),
            (STEPPERS, Moment.LEASE),
        },
    ),
    ids=lambda value: NAMES.get(value, value),
)
def test_a_drive_that_obeys_is_never_suspected(robot: Robot, moment: Moment):
    outcome = tried(robot, "runaway off", moment)
    assert outcome.event is None
    if moment is Moment.DISARM:
        assert outcome.answer.startswith("disarmed after")
    if moment is Moment.END:
        assert not outcome.powered
