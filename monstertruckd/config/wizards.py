"""The calibration wizards, each declared once: keys, lifetime, prerequisites, options and place in the order.

Permitted changes (`calibration.py`), grades and expiry (`expiry.py`), and the commands `calibrate NAME` and `calibrate
all` are derived from these rows. The procedure is a class in `monstertruckd/tools/calibrate/`, loaded when the wizard
runs. This module imports nothing, because every command line loads this table.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, NamedTuple

if TYPE_CHECKING:
    from monstertruckd.config.truck import TruckConfig

STEERING: Final = "devices.steering.driver"
COMPASS: Final = "devices.compass.driver.iron"
LIDAR: Final = "devices.lidar.mount"
IMU: Final = "devices.imu.driver.correction"
STABILISER: Final = "devices.stabiliser.driver"
SONAR: Final = "devices.sonar.driver"
CAMERA_LENS: Final = "devices.camera.driver.lens"
CAMERA_MOUNT: Final = "devices.camera.mount"

TURN_IN_A_METRE: Final = ("differential", "skid_steer", "truck")
"""Bodies that can turn within one metre."""
MOTION: Final = ("state/odometry", "state/pose")
TAPE: Final = "Standard error of one tape reading, mm."
HEIGHT: Final = "Standard error of a height, mm."
STRING: Final = "Standard error of the string's direction, mm per m."


class Lifetime(NamedTuple):
    """Validity of a wizard's result."""

    days: int
    metres: float | None
    """Distance travelled, m; None: not limited."""
    role: str
    """Measured device."""
    topics: tuple[str, ...]
    """Topics that depend on the result."""


class Goal(NamedTuple):
    """Target for the half-width of the confidence interval, in the estimate's unit."""

    half: float
    share: bool = False
    """``half`` is a fraction of the value."""


class WizardOption(NamedTuple):
    """An option of the wizard's command, and the field of its procedure that it sets."""

    name: str
    default: float | bool | str
    """Type of the option: int, float, bool (a flag) or str (one of ``choices``)."""
    help: str
    low: float | None = None
    high: float | None = None
    scale: float = 1.0
    """Factor from the unit of the option to the unit of the field."""
    choices: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class SequenceStep:
    """One run of a wizard in ``calibrate all``."""

    complete: str
    """Estimate that exists once this step is done."""
    needs: tuple[str, ...] = ()
    """Steps that must precede it if the robot has them, ``wizard.complete``."""
    rough: bool = False
    """Whether it is a first measurement for the other wizards: skipped once this wizard has a result."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Options that differ from the defaults."""
    fits: Callable[["TruckConfig"], bool] = lambda _: True
    """Whether the robot needs this step."""


@dataclass(frozen=True, slots=True)
class WizardKind:
    """One calibration wizard."""

    name: str
    doc: str
    """Help of its command: result, procedure, and names of its questions."""
    procedure: str
    """Place ``module:Class`` of the procedure; built from the options by its ``of``, if any."""
    keys: tuple[str, ...]
    """Values of the configuration that it may set (``*`` matches any name). If two wizards measure the same value, the
    newer measurement is used.
    """
    lifetime: Lifetime
    """Validity, from experience rather than measurement: tyres wear, linkages and mounts are knocked, iron changes."""
    goals: Mapping[str, Goal]
    """Goals by the estimate's name; ``*_x`` matches every name with that ending."""
    steps: tuple[SequenceStep, ...]
    fits: Callable[["TruckConfig"], bool]
    """Whether the wizard applies to the robot."""
    options: tuple[WizardOption, ...] = ()
    extra: str | None = None
    """Extra of the distribution without which the procedure does not load."""

    def make(self, **given: Any) -> Any:
        """Return the procedure with these options.

        Raises:
            InputError: the options are inconsistent.
        """
        from monstertruck_runtime.plugins import load  # noqa: PLC0415 - not by every command line that reads the table

        procedure = load(self.procedure)
        scaled = {
            option.name: value if option.scale == 1.0 else value * option.scale
            for option in self.options
            if (value := given.get(option.name, option.default)) is not None
        }
        return getattr(procedure, "of", procedure)(**scaled)


def _truck_with(*roles: str) -> Callable[["TruckConfig"], bool]:
    return lambda config: config.body.kind == "truck" and set(roles) <= config.devices.present().keys()


def _measures_battery(config: "TruckConfig") -> bool:
    steering = config.devices.steering
    return config.monitors.battery is not None or (steering is not None and steering.driver.battery is not None)


def _has_lens(config: "TruckConfig") -> bool:
    return getattr(getattr(config.devices.camera, "driver", None), "lens", None) is not None


_ROWS: Final = (
    WizardKind(
        name="battery",
        doc="""Scale of the battery voltage from a multimeter; nothing moves.

        Asks `meter` (V) and `another` (yes or no), until that is no.
        """,
        procedure="monstertruckd.tools.calibrate.battery:BatteryWizard",
        keys=(
            f"{STEERING}.battery.gain",
            f"{STEERING}.battery.offset",
            "monitors.battery.divider",
            "monitors.battery.offset",
        ),
        lifetime=Lifetime(365, None, "steering", ("sensor/battery",)),
        goals={"gain": Goal(0.02, share=True), "offset": Goal(0.1)},
        steps=(SequenceStep("gain"),),
        fits=_measures_battery,
        options=(
            WizardOption("meter_error", 0.5, "Proportional error of the meter, percent.", 0, 10, scale=1e-2),
            WizardOption("meter_digits", 0.02, "Constant error of the meter, V.", 0, 1),
            WizardOption("fresh", False, "Discard the readings of earlier runs."),
        ),
    ),
    WizardKind(
        name="drive",
        doc="""Which way is forward, and how far a turn of the motor goes: runs along a tape.

        Asks `clear`, `forward` and, for each run, `mark` and `distance` (m), and without a compass `straight` (yes or
        no).
        """,
        procedure="monstertruckd.tools.calibrate.drive:DriveWizard",
        keys=("geometry.drive_ratio", "devices.drive.driver.inverted"),
        lifetime=Lifetime(180, 20_000.0, "drive", MOTION),
        goals={"drive_ratio": Goal(0.01, share=True)},
        steps=(
            SequenceStep("inverted", rough=True, options={"sign_only": True}),
            SequenceStep("drive_ratio", needs=("compass.hard_x",)),
        ),
        fits=_truck_with("drive"),
        options=(
            WizardOption("runs", 4, "Number of taped runs.", 3, 50),
            WizardOption("metres", 2.0, "Length of a run, m.", 0.5, 20),
            WizardOption("tape_error", 2.0, TAPE, 0.1, 50, scale=1e-3),
            WizardOption("sign_only", False, "Stop once the forward direction is known."),
        ),
    ),
    WizardKind(
        name="steering",
        doc="""Centre, direction, travel and pulse map of both axles: arcs, circles, and straights along a string.

        Asks `clear` and, for each string, `string` and `offset` (cm).
        """,
        procedure="monstertruckd.tools.calibrate.steering:SteeringWizard",
        keys=(
            *(
                f"{STEERING}.{axle}.{name}"
                for axle in ("front", "rear")
                for name in ("centre_us", "scale_us_per_deg", "direction", "min_us", "max_us")
            ),
            f"{STEERING}.dead_time",
            f"{STEERING}.lag",
            "body.turn_deficit.*",
        ),
        lifetime=Lifetime(90, 10_000.0, "steering", MOTION),
        goals={  # 0.5 degrees correspond to 8.5 us
            "front_centre": Goal(8.5),
            "rear_centre": Goal(8.5),
            "front_scale": Goal(0.025, share=True),
            "rear_scale": Goal(0.025, share=True),
            "delay": Goal(0.015),
        },
        steps=(
            SequenceStep("front_centre", needs=("drive.inverted",), rough=True, options={"rough": True}),
            SequenceStep("front_scale", needs=("drive.drive_ratio", "compass.hard_x")),
        ),
        fits=_truck_with("steering", "compass", "drive"),
        options=(
            WizardOption("rough", False, "Determine directions and rough centres, before the compass is calibrated."),
            WizardOption("strings", 3, "Number of straight runs along a string; 0: no string.", 0, 20),
            WizardOption("string_error", 3.5, STRING, 0.5, 50, scale=1e-3),
        ),
    ),
    WizardKind(
        name="compass",
        doc="Magnetism of the robot (hard and soft iron), from a circle driven forwards and backwards. Asks `clear`.",
        procedure="monstertruckd.tools.calibrate.compass:CompassWizard",
        keys=tuple(f"{COMPASS}.{name}" for name in ("hard_x", "hard_y", "soft_xx", "soft_xy", "soft_yy")),
        lifetime=Lifetime(90, None, "compass", ("sensor/compass", *MOTION)),
        goals={  # 2 degrees in a horizontal field of 25 uT
            "hard_x": Goal(0.87),
            "hard_y": Goal(0.87),
            "soft_xx": Goal(0.035),
            "soft_yy": Goal(0.035),
        },
        steps=(SequenceStep("hard_x", needs=("steering.front_centre",)),),
        fits=_truck_with("compass"),
    ),
    WizardKind(
        name="odometry",
        doc="""Distance scale, wheelbase and steering offset of dead reckoning: squares driven to both sides.

        Asks `clear` and, for each square, `mark`, `side` (m), `ahead` and `left` (cm).
        """,
        procedure="monstertruckd.tools.calibrate.odometry:OdometryWizard",
        keys=(
            "geometry.drive_ratio",
            "geometry.wheelbase",
            f"{STEERING}.front.centre_us",
            f"{STEERING}.rear.centre_us",
        ),
        lifetime=Lifetime(180, 20_000.0, "drive", MOTION),
        goals={
            "drive_ratio": Goal(0.01, share=True),
            "wheelbase": Goal(0.01, share=True),
            "offset": Goal(0.5),
        },
        steps=(SequenceStep("wheelbase", needs=("steering.front_scale",)),),
        fits=_truck_with("steering", "compass", "drive"),
        options=(
            WizardOption("rounds", 1, "Number of squares in each direction.", 1, 10),
            WizardOption("side", 1.5, "Straight part of a side, m.", 0.5, 10),
            WizardOption("tape_error", 2.0, TAPE, 0.1, 50, scale=1e-3),
            WizardOption("string_error", 3.5, STRING, 0.5, 50, scale=1e-3),
        ),
    ),
    WizardKind(
        name="lidar",
        doc="""Where the lidar sits on the body, and its clock offset to odometry: quarter circles and straights.

        Asks with heights `centre`, `ahead` and `left` (cm), and `clear`.
        """,
        procedure="monstertruckd.tools.calibrate.lidar:LidarWizard",
        keys=tuple(f"{LIDAR}.{name}" for name in ("x", "y", "yaw", "roll", "pitch")),
        lifetime=Lifetime(180, 20_000.0, "lidar", ("state/pose",)),
        goals={
            "x": Goal(0.010),
            "y": Goal(0.010),
            "yaw": Goal(0.0087),
            "roll": Goal(0.0087),
            "pitch": Goal(0.0087),
        },
        steps=(  # a stabiliser's zeros level the lidar; without one the lidar's own tilt is measured
            SequenceStep(
                "pitch",
                needs=("odometry.wheelbase",),
                options={"heights": True},
                fits=lambda config: config.devices.stabiliser is None,
            ),
            SequenceStep(
                "x",
                needs=("odometry.wheelbase", "stabiliser.pitch_zero"),
                fits=lambda config: config.devices.stabiliser is not None,
            ),
        ),
        fits=_truck_with("lidar", "compass"),
        options=(
            WizardOption("rounds", 1, "Number of full circles in each direction, driven in quarters.", 1, 10),
            WizardOption("heights", False, "Ask for the heights of the beam, to determine pitch and roll."),
            WizardOption("tape_error", 2.0, HEIGHT, 0.1, 50, scale=1e-3),
        ),
    ),
    WizardKind(
        name="imu",
        doc="Biases of the inertial unit at rest, and the scale of its yaw rate from full circles. Asks `clear`.",
        procedure="monstertruckd.tools.calibrate.imu:ImuWizard",
        keys=tuple(f"{IMU}.{name}" for name in ("rate_x", "rate_y", "rate_z", "rate_scale", "force_x", "force_y")),
        lifetime=Lifetime(90, None, "imu", MOTION),
        goals={"rate_z": Goal(0.002), "rate_scale": Goal(0.01, share=True)},
        steps=(SequenceStep("rate_scale", needs=("odometry.wheelbase",)),),
        fits=_truck_with("imu"),
        options=(
            WizardOption("rounds", 2, "Number of full circles in each direction.", 1, 10),
            WizardOption("still", False, "Measure biases only: the robot does not move, the scale is kept."),
        ),
    ),
    WizardKind(
        name="slip",
        doc="Turning centres and wheel radii of a skid-steer body, from arcs observed by a test stand or in "
        "the map. Asks `clear`.",
        procedure="monstertruckd.tools.calibrate.slip:SlipWizard",
        keys=tuple(f"body.{name}" for name in ("icr_left", "icr_right", "icr_x", "gain_left", "gain_right")),
        lifetime=Lifetime(90, 5_000.0, "wheels", MOTION),
        goals={
            "icr_left": Goal(0.03, share=True),
            "icr_right": Goal(0.03, share=True),
            "gain_left": Goal(0.01, share=True),
            "gain_right": Goal(0.01, share=True),
        },
        steps=(SequenceStep("icr_left"),),
        fits=lambda config: config.body.kind == "skid_steer" and config.stand != "none",
        options=(
            WizardOption(
                "by", "stand", "Reference for the robot's pose: stand, or pose (in its map).", choices=("stand", "pose")
            ),
            WizardOption("rounds", 2, "Number of times each arc is driven there and back.", 1, 20),
        ),
    ),
    WizardKind(
        name="sonar",
        doc="""Places, directions and cones of the sonars, and the speed of sound: arcs along a flat wall.

        Asks `park`, `wall` (m) and `clear`.
        """,
        procedure="monstertruckd.tools.calibrate.sonar:SonarWizard",
        keys=(
            f"{SONAR}.field_of_view",
            f"{SONAR}.speed_of_sound",
            *(f"{SONAR}.sonars.*.mount.{name}" for name in ("x", "y", "yaw")),
        ),
        lifetime=Lifetime(180, 20_000.0, "sonar", ("sensor/sonar",)),
        goals={
            "cone": Goal(0.035),
            "speed_of_sound": Goal(0.01, share=True),
            "*_x": Goal(0.015),
            "*_y": Goal(0.015),
            "*_yaw": Goal(0.052),
        },
        steps=(SequenceStep("cone", needs=("odometry.wheelbase", "slip.icr_left")),),
        fits=lambda config: "sonar" in config.devices.present() and config.body.kind in TURN_IN_A_METRE,
        options=(
            WizardOption("turn", 360.0, "Angle of each arc, degrees.", 190, 720, scale=math.pi / 180),
            WizardOption("tape_error", 2.0, "Standard error of the distance, mm.", 0.1, 50, scale=1e-3),
        ),
    ),
    WizardKind(
        name="stabiliser",
        doc="""Zero and direction of both servos below the lidar: heights of its beam, then blocks under the wheels.

        Nothing drives. Asks `level`, `centre`, `ahead`, `left` (cm), `nose` and `side`.
        """,
        procedure="monstertruckd.tools.calibrate.stabiliser:StabiliserWizard",
        keys=tuple(f"{STABILISER}.{joint}.{name}" for joint in ("pitch", "roll") for name in ("zero", "direction")),
        lifetime=Lifetime(180, 20_000.0, "stabiliser", ("state/pose",)),
        goals={"pitch_zero": Goal(3.4), "roll_zero": Goal(3.4)},  # 1 degree
        steps=(SequenceStep("pitch_zero", needs=("odometry.wheelbase",)),),
        fits=lambda config: {"stabiliser", "compass", "lidar"} <= config.devices.present().keys(),
        options=(WizardOption("tape_error", 2.0, HEIGHT, 0.1, 50, scale=1e-3),),
    ),
    WizardKind(
        name="camera",
        doc="""Lens of the camera, and where it sits against the lidar: a printed board held before both.

        Nothing drives. Asks `board`; `stand print` makes the board.
        """,
        procedure="monstertruckd.tools.calibrate.camera:CameraWizard",
        keys=(f"{CAMERA_LENS}.*", f"{CAMERA_MOUNT}.*"),
        lifetime=Lifetime(365, 20_000.0, "camera", ("state/points",)),
        goals={
            "focal_x": Goal(0.01, share=True),
            "focal_y": Goal(0.01, share=True),
            "centre_x": Goal(4.6),  # 0.5 degrees correspond to 4.6 of 522 pixels
            "centre_y": Goal(4.6),
            "x": Goal(0.015),
            "y": Goal(0.015),
            "z": Goal(0.015),
            "yaw": Goal(0.0087),
            "pitch": Goal(0.0087),
            "roll": Goal(0.0087),
        },
        steps=(SequenceStep("focal_x", needs=("lidar.pitch", "lidar.x")),),
        fits=_has_lens,
        options=(
            WizardOption("columns", 8, "Number of squares across the board.", 4, 30),
            WizardOption("rows", 6, "Number of squares down the board.", 4, 30),
            WizardOption("square", 40.0, "Printed side length of a square, mm.", 5, 1000, scale=1e-3),
            WizardOption("marker", 30.0, "Printed side length of a marker, mm.", 4, 1000, scale=1e-3),
            WizardOption("lens_only", False, "Calibrate the lens only, not the mount."),
            WizardOption("patience", 60.0, "Seconds without a new view after which the wizard stops.", 5, 3600),
        ),
        extra="vision",
    ),
)

WIZARDS: Final[Mapping[str, WizardKind]] = {row.name: row for row in _ROWS}
"""Wizards by name, in the order of the commands."""


class WizardRun(NamedTuple):
    """A step of a wizard in ``calibrate all``."""

    wizard: WizardKind
    step: SequenceStep

    @property
    def name(self) -> str:
        """Name of the wizard."""
        return self.wizard.name


def sequence() -> Iterator[WizardRun]:
    """Yield all steps in the order of ``calibrate all``.

    Each step follows the steps it needs; otherwise the order of the wizards applies.
    """
    runs = {f"{row.name}.{step.complete}": WizardRun(row, step) for row in _ROWS for step in row.steps}
    done: set[str] = set()

    def visit(name: str) -> Iterator[WizardRun]:
        if name not in done:
            done.add(name)
            for needed in runs[name].step.needs:
                yield from visit(needed)
            yield runs[name]

    for name in runs:
        yield from visit(name)
