"""What `new-robot` asks: one model that defines questions, options and their checks."""

import math
from typing import Annotated, Any, Final, Literal, Self, get_args, get_origin

from pydantic import Field, TypeAdapter, ValidationError, model_validator

from monstertruck_drivers.catalog import DEVICES
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.base import Name, Positive, Schema, field_docs, first_mistake
from monstertruck_schemas.body import Metres

Body = Literal[
    "differential",
    "skid_steer",
    "ackermann",
    "bicycle",
    "tricycle",
    "truck",
    "mecanum",
    "omni",
    "synchro",
    "independent",
]
UNSTEERED: Final = ("differential", "skid_steer", "mecanum", "omni")
"""Bodies without steering servos."""
FRONT: Final = ("ackermann", "bicycle", "tricycle")
"""Bodies with one steering servo, at the front."""
SERVO_BOARDS: Final = ("maestro_esc", "pca9685_esc")
"""Controllers with outputs for speed controller and servos."""
SERVOS: Final = (("maestro", "pca9685"), ("drive", "maestro", "pca9685"))
"""Steering of other controllers: without, and with a servo output."""
Drive = Literal["vesc", "arduino_bridge", "steppers", "epos", "maestro_esc", "pca9685_esc"]
LIDARS: Final = tuple(kind.name for kind in DEVICES.of_role("lidar"))
NONE: Final = "none"


class Answers(Schema):
    """Description of a robot."""

    name: Name
    """Name of the robot"""
    body: Body
    """How it moves; independent: a motor and a servo for every wheel"""
    wheelbase: Metres
    """Distance between front and rear axle (m); of a body that steers nothing, the length of the bicycle that requests
    speak of"""
    track: Metres
    """Distance between left and right wheels (m); of three omni wheels, of the two behind"""
    wheel_radius: Metres
    """Wheel radius (m)"""
    length: Metres
    """Length (m)"""
    width: Metres
    """Width (m)"""
    mass: Positive
    """Mass (kg)"""
    speed: Annotated[float, Field(ge=0.05, le=10)]
    """Maximum speed (m/s)"""
    deceleration: Annotated[float, Field(ge=0.1, le=10)] | None = None
    """Measured deceleration of a stop (m/s^2); none: 4/3 of the speed in one second"""
    drive: Drive
    """Motor controller"""
    drive_ratio: Annotated[float, Field(ge=1, le=5000)] = 1.0
    """Turns of the measured shaft per wheel turn: of the motor, or 1 for encoders on the wheels"""
    pull: Positive | None = None
    """Maximum force of all driven wheels (N); none: 1.5 times the force of the deceleration"""
    steering: Literal["none", "drive", "maestro", "pca9685"] = "none"
    """Steering servos: on the motor controller's output, on a Maestro, on a PCA9685"""
    lidar: str = NONE
    """Laser scanner: a kind of the catalog, with its model after a colon if it has several; sheet_lidar: by its data
    sheet"""
    lidar_x: float = 0.0
    """Lidar ahead of the robot's centre (m)"""
    lidar_z: Positive = 0.15
    """Height of the lidar's plane (m)"""
    beams: Annotated[int, Field(ge=8, le=8192)] = 450
    """Beams of a scan"""
    field_of_view: Annotated[float, Field(gt=0, le=360)] = 360.0
    """Angle that a scan covers (degrees)"""
    range_max: Annotated[float, Field(gt=0.1, le=60)] = 12.0
    """Range (m)"""
    direction: Literal["clockwise", "counter_clockwise"] = "clockwise"
    """Turning direction of the lidar, seen from above"""
    scan_rate: Annotated[float, Field(ge=2, le=100)] = 10.0
    """Scans per second"""
    attitude: Literal["none", "os4000", "bno085", "wt61"] = "none"
    """Compass or inertial measurement unit"""
    battery: Literal["none", "drive", "steering", "iio"] = "none"
    """Device that measures the battery"""
    cells: Annotated[int, Field(ge=1, le=14)] = 3
    """Cells of the pack in series"""
    camera: Literal["none", "webcam", "mjpeg"] = "none"
    """Camera; mjpeg: rpicam-vid, or a network camera"""
    camera_x: float = 0.0
    """Camera ahead of the robot's centre (m)"""
    camera_z: Positive = 0.15
    """Height of the camera (m)"""

    @property
    def lidar_kind(self) -> str:
        """Kind of the lidar."""
        return self.lidar.partition(":")[0]

    @property
    def lidar_driver(self) -> dict[str, Any]:
        """Settings of the lidar's driver."""
        kind, _, model = self.lidar.partition(":")
        found: dict[str, Any] = {"kind": kind} | ({"model": model} if model else {})
        if kind == "sheet_lidar":
            view = math.tau if self.field_of_view == 360.0 else math.radians(self.field_of_view)
            found |= {"beams": self.beams, "field_of_view": view, "range_max": self.range_max}
            found |= {"direction": self.direction, "rate": self.scan_rate}
        return found

    @property
    def braking(self) -> float:
        """Deceleration of a stop (m/s^2)."""
        per_second = 4 / 3
        return self.deceleration or max(per_second * self.speed, 0.5)

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.lidar_kind not in (NONE, *LIDARS):
            raise ValueError(f"lidar {self.lidar}: expected none or one of {', '.join(LIDARS)}")
        if self.lidar != NONE:
            self._check_model()
        self._check_steering()
        if self.battery == "drive" and self.drive not in ("vesc", "maestro_esc"):
            raise ValueError(f"battery drive: {self.drive} does not measure it; expected none, steering or iio")
        if self.battery == "steering" and self.steering != "maestro":
            raise ValueError("battery steering: a Maestro measures it; expected steering maestro")
        return self

    def _check_model(self) -> None:
        kind = DEVICES[self.lidar_kind]
        if ":" in self.lidar and "model" not in kind.settings_class().model_fields:
            raise ValueError(f"lidar {self.lidar}: {kind.name} has one model; expected {kind.name}")
        try:
            kind.settings_class().model_validate(self.lidar_driver, strict=False)
        except ValidationError as error:
            raise ValueError(f"lidar {self.lidar}: {first_mistake(error)}") from error

    def _check_steering(self) -> None:
        """Refuse steering that the body does not have, and a controller whose servo outputs are left aside."""
        if self.body in UNSTEERED:
            if self.steering != NONE:
                raise ValueError(f"steering {self.steering}: body {self.body} steers nothing; expected none")
            return
        outputs = ("drive",) if self.drive in SERVO_BOARDS else SERVOS[self.drive == "vesc" and self.body in FRONT]
        if self.steering not in outputs:
            raise ValueError(
                f"steering {self.steering}: body {self.body} with drive {self.drive} expects {' or '.join(outputs)}"
            )


def asked(name: str, answers: dict[str, Any]) -> bool:
    """Return whether a question matters after the answers so far."""
    lidar = str(answers.get("lidar", NONE))
    match name:
        case "beams" | "field_of_view" | "range_max" | "direction" | "scan_rate":
            return lidar.startswith("sheet_lidar")
        case "lidar_x" | "lidar_z":
            return lidar != NONE
        case "camera_x" | "camera_z":
            return bool(answers.get("camera", NONE) != NONE)
        case "cells":
            return bool(answers.get("battery", NONE) != NONE)
        case "steering":
            return answers.get("body") not in UNSTEERED
        case _:
            return True


def question(name: str) -> str:
    """Meaning of an answer, with its choices."""
    text = " ".join(field_docs(Answers)[name].split())
    annotation = Answers.model_fields[name].annotation
    kinds = get_args(annotation) if get_origin(annotation) is Literal else (NONE, *LIDARS) if name == "lidar" else ()
    return f"{text} ({', '.join(kinds)})" if kinds else text


def mistake(name: str, answer: Any) -> str | None:
    """Mistake of one answer by itself, or None."""
    field = Answers.model_fields[name]
    kind: Any = Annotated[field.annotation, field, *field.metadata]
    try:
        TypeAdapter(kind).validate_python(answer, strict=False)
    except ValidationError as error:
        return first_mistake(error, name)
    return None


def check_complete(answers: dict[str, Any]) -> None:
    """Refuse answers that lack one without a default.

    Raises:
        InputError: names the missing options.
    """
    required = [name for name, field in Answers.model_fields.items() if field.is_required()]
    if missing := [f"--{name.replace('_', '-')}" for name in required if name not in answers]:
        raise InputError(f"missing {', '.join(missing)}; on a terminal, new-robot asks for them")
