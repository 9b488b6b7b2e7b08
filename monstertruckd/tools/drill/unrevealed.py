"""Families of faults that no second measure of the robots here reveals, and the limit that remains.

A drill prints the tested families without a reason: families of this table with their limit, the others by name.
"""

from collections.abc import Iterable
from fnmatch import fnmatchcase
from typing import Final, NamedTuple


class Unrevealed(NamedTuple):
    """Families with the same explanation."""

    families: tuple[str, ...]
    """Patterns of the family names."""
    why: str
    """Reason why there is no redundant measurement."""
    limit: str
    """Limit of the effect."""

    def holds(self, family: str) -> bool:
        """Return whether this entry describes a family."""
        return any(fnmatchcase(family, pattern) for pattern in self.families)


UNREVEALED: Final = (
    Unrevealed(
        ("camera image *", "camera open *", "camera close *"),
        "there is one camera",
        "pictures only find points of interest; nothing is driven by them",
    ),
    Unrevealed(
        ("compass temperature *", "compass field_? *", "compass acceleration_? *"),
        "neither gate nor odometry reads them",
        "headings are compared with the turns of wheels and scans",
    ),
    Unrevealed(
        ("compass pitch *", "compass roll *"),
        "no other sensor measures the tilt",
        "`gate.tilt` by the false value, `gate.speed`",
    ),
    Unrevealed(
        (
            "drive* maximal_profile_velocity *",
            "drive* profile_acceleration *",
            "drive* profile_deceleration *",
            "drive* quick_stop_deceleration *",
        ),
        "written or read only while the drive is prepared",
        "`uncommanded_motion` where the shaft turns faster or stops later than ordered",
    ),
    Unrevealed(
        ("drive* mode_of_operation *", "drive* mode_of_operation_display *"),
        "written and read only while the drive is prepared",
        "`uncommanded_motion` where the shaft turns otherwise than ordered",
    ),
    Unrevealed(
        ("drive* current_actual *",),
        "one sensor measures a motor's current",
        "position and velocity decide whether a shaft is blocked or runs away",
    ),
    Unrevealed(
        ("drive* enable *", "drive* disable_voltage *"),
        "obeyed only when the power stage is switched",
        "the quick stop before it, repeated; the deadman line",
    ),
    Unrevealed(
        ("stabiliser load_? *", "stabiliser speed_? *", "stabiliser voltage_? *", "stabiliser temperature_? *"),
        "each servo has one sensor of them",
        "the servo's own alarms take its torque away",
    ),
    Unrevealed(
        ("stabiliser moving_speed_? *", "stabiliser torque_limit_? *", "stabiliser torque_enable_? *"),
        "written only when a joint begins to hold",
        "`gate.scan_tilt`: a scan whose plane is tilted is not valid",
    ),
    Unrevealed(
        ("steering speed_? *", "steering acceleration_? *"),
        "written only while the controller is prepared",
        "`steering_dead` where the truck turns otherwise than ordered",
    ),
    Unrevealed(
        ("lidar* range offset",),
        "a constant error of all ranges hardly changes their motion, except in small rooms",
        "the robot stops before obstacles nearer or further by the error; beyond `gate.obstacle.ahead` it touches them",
    ),
    Unrevealed(
        ("lidar adjust *", "lidar stream *"),
        "commanded only at the start of a session",
        "`scan_stale`: without scans the robot stops",
    ),
)


def limit_of(family: str) -> Unrevealed | None:
    """Return the row that describes a family; None if a second measure should reveal it."""
    return next((row for row in UNREVEALED if row.holds(family)), None)


def explained(families: Iterable[str]) -> tuple[dict[Unrevealed, list[str]], list[str]]:
    """Return the families by the row that describes them, and those without a row."""
    by_row: dict[Unrevealed, list[str]] = {}
    others = []
    for family in families:
        row = limit_of(family)
        if row is None:
            others.append(family)
        else:
            by_row.setdefault(row, []).append(family)
    return by_row, others
