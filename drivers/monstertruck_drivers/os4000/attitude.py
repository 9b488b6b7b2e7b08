"""Convert a sentence in the device's units and signs to an attitude in SI units and REP 103 signs."""

import math
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from monstertruck_drivers.os4000.config import IronConfig, Os4000Config
from monstertruck_drivers.os4000.protocol import Sentence
from monstertruck_schemas.sensor import STANDARD_GRAVITY, Attitude, Vector3

Real = TypeVar("Real", float, NDArray[np.float64])


def level_field(field: tuple[Real, Real, Real], pitch: Real, roll: Real, iron: IronConfig) -> tuple[Real, Real]:
    """Return the horizontal component of the earth's field (forward, left), compensated for tilt.

    Its angle is the heading, clockwise from magnetic north: after a right turn, north is to the truck's left.

    Args:
        field: measured along the device's x (forward), y (left) and z (up) axes.
        pitch: nose down positive (REP 103) (rad).
        roll: right side down positive (rad).
        iron: calibration to apply; hard iron in the same unit as ``field``.
    """
    x, y = field[0] - iron.hard_x, field[1] - iron.hard_y
    x, y = iron.soft_xx * x + iron.soft_xy * y, iron.soft_xy * x + iron.soft_yy * y
    left = np.cos(roll) * y - np.sin(roll) * field[2]
    up = np.sin(roll) * y + np.cos(roll) * field[2]
    return np.cos(pitch) * x + np.sin(pitch) * up, left


MILLIGAUSS: Final = 0.1
"""Microtesla per milligauss."""


def to_attitude(sentence: Sentence, config: Os4000Config, stamp: int, received: int, seq: int) -> Attitude:
    """Convert one sentence.

    In the device's convention, positive pitch is nose up and positive roll is right side down; in REP 103, positive
    pitch is nose DOWN (about y, left) and positive roll is right side down (about x, forward), so only pitch changes
    sign. Its acceleration is +1 g along z (up) at rest, with x forward and y left (confirmed by a manufacturer's sample
    with pitch 2.5 and roll -14 degrees).

    With a calibrated ``iron``, the heading is computed from the field instead; ``magnetic_field`` remains as measured.

    Raises:
        ValueError: heading, pitch or roll (or the field, where it is needed) is absent or out of range; the message
            names the value.
    """
    heading, pitch, roll = sentence.heading, sentence.pitch, sentence.roll
    if heading is None or not 0 <= heading < 360:
        raise ValueError(f"heading {heading} is not within [0, 360)")
    if pitch is None or abs(pitch) > 90:
        raise ValueError(f"pitch {pitch} is not within [-90, 90]")
    if roll is None or abs(roll) > 180:
        raise ValueError(f"roll {roll} is not within [-180, 180]")
    return Attitude(
        stamp=stamp,
        received=received,
        seq=seq,
        frame=config.frame,
        heading=math.radians(heading) if config.iron == _NO_IRON else _heading(sentence, config.iron),
        roll=math.radians(roll),
        pitch=-math.radians(pitch),
        temperature=sentence.temperature,
        magnetic_field=_scaled(sentence.field, MILLIGAUSS),
        acceleration=_scaled(sentence.acceleration, STANDARD_GRAVITY),
        heading_disturbed=_is_disturbed(sentence, config),
        tilt_valid=_is_tilt(sentence, config),
    )


_NO_IRON: Final = IronConfig()


def _heading(sentence: Sentence, iron: IronConfig) -> float:
    if sentence.field is None or sentence.pitch is None or sentence.roll is None:
        raise ValueError("the magnetic field is missing, which the calibrated heading needs")
    x, y, z = (component * MILLIGAUSS for component in sentence.field)
    north, left = level_field((x, y, z), -math.radians(sentence.pitch), math.radians(sentence.roll), iron)
    return math.atan2(left, north) % (2 * math.pi)


def _scaled(vector: tuple[float, float, float] | None, factor: float) -> Vector3 | None:
    return None if vector is None else Vector3(x=vector[0] * factor, y=vector[1] * factor, z=vector[2] * factor)


def _length(vector: tuple[float, float, float] | None, length: float | None) -> float | None:
    return math.hypot(*vector) if vector is not None else length


def _is_disturbed(sentence: Sentence, config: Os4000Config) -> bool:
    length = _length(sentence.field, sentence.field_length)
    if length is None or config.field_strength is None:
        return False
    return abs(length * MILLIGAUSS / config.field_strength - 1) > config.field_tolerance


def _is_tilt(sentence: Sentence, config: Os4000Config) -> bool:
    length = _length(sentence.acceleration, sentence.acceleration_length)
    return length is None or abs(length - 1) <= config.gravity_tolerance
