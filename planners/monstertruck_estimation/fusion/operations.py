"""What may happen to the belief, each at its instant."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class WheelWay:
    """The base moved by ``delta`` (dx, dy, dyaw in base at ``since``), say the wheels."""

    since: int
    stamp: int
    delta: Array
    """Shape (3,), m and rad, as if on level ground."""
    covariance: Array
    """Shape (3, 3)."""
    slipping: bool = False
    """The wheels are known not to hold the ground."""


@dataclass(frozen=True, slots=True)
class ScanWay:
    """The base moved by ``delta`` between two scans."""

    since: int
    stamp: int
    delta: Array
    """Shape (3,), m and rad."""
    covariance: Array
    """Shape (3, 3), of the later scan's place on the map both are matched to, in base's axes; huge along a corridor."""


@dataclass(frozen=True, slots=True)
class ScanMark:
    """A scan was taken; a later one will tell how the base moved since."""

    stamp: int
    covariance: Array
    """Shape (3, 3), of its place, as in ``ScanWay``."""


@dataclass(frozen=True, slots=True)
class Heading:
    """A reading of the compass."""

    stamp: int
    yaw: float
    """Counter-clockwise from magnetic north, rad."""
    disturbed: bool = False
    """The device itself says so."""
    taken_back: bool = False
    """A disturbance was noticed soon after it."""
    field: float | None = None
    """Strength of the magnetic field, in the device's unit."""
    tilt: tuple[float, float] | None = None
    """Roll and pitch, rad, while they are tilt."""


Operation = WheelWay | ScanWay | ScanMark | Heading
