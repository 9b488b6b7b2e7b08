"""Messages are strict and frozen, their arrays read-only, absent is None."""

import json

import numpy as np
import pytest
from pydantic import ValidationError

from monstertruck_schemas.base import Pose2D, Twist2D, servo_fields
from monstertruck_schemas.cmd import SteeringCommand
from monstertruck_schemas.event import Event, Severity
from monstertruck_schemas.plan import Path
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveForm, DriveRequest, RequestedTwist, Role
from monstertruck_schemas.sensor import LaserScan, SteeringFeedback
from monstertruck_schemas.state import GateMode, GateState, Grid, Odometry

HEADER = {"stamp": 1, "received": 2, "seq": 3}


def scan(ranges: np.ndarray, **changes: object) -> LaserScan:
    values = {
        "start_angle": -2.0,
        "end_angle": 2.0,
        "time_increment": 1e-4,
        "scan_time": 0.1,
        "range_min": 0.02,
        "range_max": 5.6,
        "ranges": ranges,
        "codes": np.full(len(ranges), 255, np.uint8),
    }
    return LaserScan(**HEADER, frame="lidar", **(values | changes))  # type: ignore[arg-type]


@pytest.mark.parametrize(("start", "end", "step"), [(-2.0, 2.0, 2.0), (2.0, -2.0, -2.0)])
def test_a_scan_says_which_way_its_lidar_turns(start: float, end: float, step: float):
    message = scan(np.ones(3), start_angle=start, end_angle=end)
    assert message.angle_increment == step
    assert message.field == (-2.0, 2.0)


def test_a_noise_that_would_make_every_range_worthless_is_refused():
    with pytest.raises(ValidationError, match="range_noise"):
        scan(np.ones(3), range_noise=1e6)


def odometry(**changes: object) -> Odometry:
    values: dict[str, object] = {
        "pose": Pose2D(x=1.0, y=2.0, yaw=0.5),
        "twist": Twist2D(vx=0.2, vy=0.0, wz=0.1),
        "pose_covariance": np.zeros(9),
        "twist_covariance": np.zeros(9),
        "age": 0.01,
    }
    return Odometry(**HEADER, frame="odom", **(values | changes))  # type: ignore[arg-type]


def test_messages_are_frozen():
    message = odometry()
    with pytest.raises(ValidationError):
        message.age = 1.0  # type: ignore[misc]


def test_arrays_are_read_only_and_never_alias_the_callers():
    mine = np.array([1.0, np.inf, 2.0])
    message = scan(mine)
    mine[0] = 9.0
    assert message.ranges[0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        message.ranges[0] = 3.0


def test_a_frozen_array_is_taken_without_a_copy():
    array = np.ones(5)
    array.flags.writeable = False
    assert scan(array).ranges is array


def test_strict_types_and_no_unknown_fields():
    with pytest.raises(ValidationError):
        odometry(age="0.1")
    with pytest.raises(ValidationError):
        odometry(unknown=1)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_not_finite_is_refused_where_absent_must_be_none(value: float):
    with pytest.raises(ValidationError):
        odometry(age=value)


def test_a_drive_request_may_carry_nan_so_that_the_gate_can_name_it():
    request = DriveRequest(
        **HEADER, source="me", role=Role.STATION, lease=0.3, nonce="n", speed=float("nan"), front=0.0
    )
    assert request.speed != request.speed


ASKED = {**HEADER, "source": "me", "role": Role.STATION, "lease": 0.3, "nonce": "n"}


def test_a_twist_is_standstill_to_a_reader_that_does_not_know_it():
    request = DriveRequest(**ASKED, speed=0.0, front=0.0, twist=RequestedTwist(vx=0.1, wz=float("nan")))
    wire = json.loads(request.model_dump_json())
    assert (wire["speed"], wire["front"], wire["rear"]) == (0.0, 0.0, 0.0)
    assert DriveRequest.model_validate_json(request.model_dump_json()).twist.vx == 0.1
    assert (request.form, request.neutral) == (DriveForm.TWIST, False)


def test_shafts_are_standstill_to_a_reader_that_does_not_know_them():
    request = DriveRequest(**ASKED, speed=0.0, front=0.0, shafts=(0.5, float("nan")))
    wire = json.loads(request.model_dump_json())
    assert (wire["speed"], wire["front"], wire["rear"], wire["twist"]) == (0.0, 0.0, 0.0, None)
    assert DriveRequest.model_validate_json(request.model_dump_json()).shafts[0] == 0.5
    assert (request.form, request.neutral, request.pace) == (DriveForm.SHAFTS, False, 0.0)
    assert DriveRequest(**ASKED, speed=0.0, front=0.0, shafts=(0.0, 5e-4)).neutral
    for wrong in ({"speed": 0.1, "shafts": (1.0,)}, {"shafts": ()}, {"shafts": (1.0,), "twist": RequestedTwist()}):
        with pytest.raises(ValidationError):
            DriveRequest(**ASKED, **{"speed": 0.0, "front": 0.0, **wrong})


def test_a_request_without_a_twist_is_read_as_before():
    old = {**HEADER, "source": "me", "role": "station", "lease": 0.3, "nonce": "n", "speed": 0.1, "front": 0.2}
    request = DriveRequest.model_validate_json(json.dumps(old))
    assert (request.form, request.twist, request.pace) == (DriveForm.AXLES, None, 0.1)


@pytest.mark.parametrize(
    "more", [{"speed": 0.1, "front": 0.0}, {"speed": 0.0, "front": 0.1}, {"speed": 0.0, "front": float("nan")}]
)
def test_a_request_has_one_form(more):
    with pytest.raises(ValidationError, match="a request has one form"):
        DriveRequest(**ASKED, **more, twist=RequestedTwist(vx=0.1))


@pytest.mark.parametrize(
    ("twist", "pace", "neutral"),
    [
        ((0.1, 0.0, 0.0), 0.1, False),
        ((-0.3, 0.4, 0.0), -0.5, False),
        ((0.0, 0.0, 0.4), 0.0, False),
        ((0.0, 0.0, 5e-4), 0.0, True),
    ],
)
def test_the_pace_of_a_twist_is_that_of_the_base(twist, pace, neutral):
    request = DriveRequest(
        **ASKED, speed=0.0, front=0.0, twist=RequestedTwist(**dict(zip(("vx", "vy", "wz"), twist, strict=True)))
    )
    assert request.pace == pytest.approx(pace)
    assert request.neutral is neutral


@pytest.mark.parametrize("angles", [(0.1, -0.2), (0.1, 0.2, 0.3, 0.4)])
def test_servos_are_two_or_four(angles):
    command = SteeringCommand(**HEADER, front=0.0, rear=0.0, **servo_fields(angles, "_servo"))
    assert command.servos == angles
    assert SteeringFeedback(**HEADER, **servo_fields(angles)).servos == angles


@pytest.mark.parametrize("shape", [8, 10])
def test_covariances_have_nine_elements(shape: int):
    with pytest.raises(ValidationError, match="expected 9 numbers"):
        odometry(pose_covariance=np.zeros(shape))
    with pytest.raises(ValidationError, match="expected 9 numbers"):
        odometry(twist_covariance=np.zeros(shape))


def test_json_round_trip():
    for message in (
        odometry(),
        Event(
            **HEADER, reason=Reason.TILT_STOP, severity=Severity.ERROR, source="gate", values={"tilt": 0.4, "n": None}
        ),
        Grid(
            **HEADER,
            resolution=0.05,
            width=2,
            height=1,
            origin=Pose2D(x=0, y=0, yaw=0),
            cells=np.array([-1, 100], np.int8),
        ),
    ):
        assert type(message).model_validate_json(message.model_dump_json()) == message


def test_the_wire_ignores_unknown_fields_but_construction_does_not():
    text = odometry().model_dump_json()[:-1] + ', "from_the_future": 1}'
    assert Odometry.model_validate_json(text, extra="ignore") == odometry()
    with pytest.raises(ValidationError):
        Odometry.model_validate_json(text)


def test_equality_is_by_value_and_type():
    assert scan(np.ones(3)) == scan(np.ones(3))
    assert scan(np.ones(3)) != scan(np.array([1.0, 1.0, 2.0]))
    assert scan(np.ones(3)) != odometry()


def test_angle_increment():
    assert scan(np.ones(5)).angle_increment == pytest.approx(1.0)
    assert scan(np.ones(1)).angle_increment == pytest.approx(4.0)


@pytest.mark.parametrize("source", ["", "a b", "x" * 65, "née"])
def test_sources_are_plain_names(source: str):
    with pytest.raises(ValidationError):
        DriveRequest(**HEADER, source=source, role=Role.STATION, lease=0.3, nonce="n", speed=0.0, front=0.0)


@pytest.mark.parametrize("lease", [0.0, -1.0, 2.5])
def test_leases_are_bounded(lease: float):
    with pytest.raises(ValidationError):
        DriveRequest(**HEADER, source="a", role=Role.STATION, lease=lease, nonce="n", speed=0.0, front=0.0)


@pytest.mark.parametrize(
    "poses",
    ["null", '"1"', '["1"]', "[{}]", "{}", "[[1, 2], [3]]", "[null]", "[1" + 400 * "0" + "]", "[true]", "1.5"],
)
def test_whatever_else_stands_for_an_array_is_a_validation_error(poses: str):
    text = '{"stamp": 1, "received": 1, "seq": 1, "frame": "odom", "directions": [], "poses": ' + poses + "}"
    with pytest.raises(ValidationError, match="poses"):
        Path.model_validate_json(text)


def test_arrays_have_one_dimension():
    with pytest.raises(ValidationError, match="one dimension"):
        Path(**HEADER, poses=np.zeros((2, 3)), directions=[])
    with pytest.raises(ValidationError, match="poses"):
        Path(**HEADER, poses=[{}], directions=[])


@pytest.mark.parametrize(
    ("mode", "reasons", "worst", "hindrances", "why"),
    [
        (GateMode.ARMED, (), Reason.DISARMED, 0, "the robot is armed"),
        (GateMode.DISARMED, (Reason.DISARMED,), Reason.DISARMED, 0, "the robot is disarmed"),
        (
            GateMode.DISARMED,
            (Reason.SCAN_STALE, Reason.DISARMED),
            Reason.SCAN_STALE,
            1,
            "no fresh lidar scan, the robot is disarmed",
        ),
    ],
)
def test_the_gate_says_why_the_truck_stands(
    mode: GateMode, reasons: tuple[Reason, ...], worst: Reason, hindrances: int, why: str
):
    state = GateState(**HEADER, mode=mode, nonce="n", speed_limit=0.0, reasons=reasons)  # type: ignore[arg-type]
    assert (state.worst, len(state.hindrances), state.why) == (worst, hindrances, why)


def test_reasons_are_of_every_robot_not_of_the_truck_alone():
    assert [reason for reason in Reason if "truck" in reason.text] == []
