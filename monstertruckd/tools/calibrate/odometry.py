"""Distance scale, wheelbase and steering offset of dead reckoning, from squares driven in both directions.

Based on the test of Borenstein and Feng ("Measurement and Correction of Systematic Odometry Errors in Mobile Robots",
IEEE Transactions on Robotics and Automation, 1996): an offset error rotates a square driven to the left and one driven
to the right in the same direction, a wheelbase error in opposite directions. The original is for two separately driven
wheels. Here the corners are arcs of a truck with two steered axles, a tape measures the first side, and the compass
measures the turn of every leg.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Final

import numpy as np

from monstertruck_kinematics.chassis import TruckChassis
from monstertruck_kinematics.elementary import Array, sinc
from monstertruck_kinematics.fitting import FitResult, least_squares
from monstertruck_runtime.errors import InputError, RequestRefusedError
from monstertruck_schemas.reasons import Reason
from monstertruckd.config.calibration import Estimate, Result, WizardName
from monstertruckd.config.wizards import STEERING
from monstertruckd.tools.calibrate.assumed import ASSUMED
from monstertruckd.tools.calibrate.statistics import Interval, estimated, known_errors
from monstertruckd.tools.calibrate.steering_model import AXLES, EYE, Maps, SteeringModel, SteeringRun
from monstertruckd.tools.calibrate.steps import Confirm, MoveRecord, MoveStep, Number, Plot
from monstertruckd.tools.calibrate.wizard import CLEAR, WizardContext

ROOM: Final = "3.5 m x 3.5 m on either side: squares of 2.4 m to the left and to the right of the robot, level"
CORNER: Final = 0.08
"""Speed in the corners, m/s: at higher speed tyres slip outwards and widen the corner."""
ANGLE: Final = 0.35
"""Angle of both axles in the corners, in opposite directions, rad."""
BELIEVED: Final = (0.05, 0.05, math.radians(6.0))
"""Standard deviations before the measurement: relative distance, relative wheelbase, servo angle (rad)."""

_MARK: Final = Confirm(
    "mark",
    "Mark the floor vertically below the middle of the front bumper, and lay a string straight ahead "
    "along the robot's axis. Done?",
)
_SIDE: Final = Number(
    "side", "Distance from the mark to the point below the middle of the front bumper now, m", 0.2, 20.0
)
_AHEAD: Final = Number(
    "ahead", "How far along the string has the middle of the front bumper moved from the mark, cm (ahead positive)?",
    -300.0, 300.0,
)  # fmt: skip
_LEFT: Final = Number("left", "And how far sideways from the string, cm (left positive)?", -300.0, 300.0)


@dataclass(frozen=True, slots=True)
class Square:
    """One driven square, and the truck's final position."""

    legs: tuple[SteeringRun, ...]
    """Sides and corners in turn."""
    side: float
    """Taped length of the first side, m."""
    off: tuple[float, float]
    """Position of the front bumper relative to its mark at the end, ahead and left, m."""


@dataclass(frozen=True, slots=True)
class OdometryWizard:
    """Wizard that drives squares alternately to the left and to the right."""

    name: ClassVar[WizardName] = "odometry"
    doc: ClassVar[str] = (
        "distance scale, wheelbase and steering offset of dead reckoning, from squares driven in both directions"
    )
    room: ClassVar[str] = ROOM
    rounds: int = 1
    """Number of squares in each direction"""
    side: float = 1.5
    """Length of its straight parts, m; corners add 0.7 m each"""
    tape_error: float = ASSUMED.tape_reading
    """Standard deviation of a tape reading, m"""
    string_error: float = ASSUMED.string_direction
    """Standard deviation of the string's direction along the truck, rad"""

    async def __call__(self, context: WizardContext) -> Result:
        """Measure."""
        if not isinstance(context.chassis, TruckChassis):
            raise RequestRefusedError(
                Reason.NOT_SUPPORTED,
                "only a body with two steered axles can drive squares of arcs; use `calibrate slip` for "
                "a skid-steer body",
            )
        maps = Maps.of(context.config)
        await context.confirm(CLEAR)
        squares = [await self._square(context, maps, side) for _ in range(self.rounds) for side in (1, -1)]
        ends = 100 * np.array([square.off for square in squares])
        context.plot(Plot("ends of the squares", "ahead of the mark (cm)", "left of the mark (cm)", ends))
        return context.fit("distance scale, wheelbase and steering offset", lambda: self.judge(context, maps, squares))

    async def _square(self, context: WizardContext, maps: Maps, sense: int) -> Square:
        await context.confirm(_MARK)
        corner = math.pi / 2 / context.chassis.bicycle.curvature(ANGLE, -ANGLE)
        legs, taped, turned = [], 0.0, 0.0
        towards = "left" if sense > 0 else "right"
        for number in range(1, 5):
            side = MoveStep(f"square to the {towards}, side {number} of 4", 0.15, metres=self.side, marked=True)  # m/s
            record = await context.move(side)
            turned += record.turned()
            legs.append(SteeringRun.of(record, maps))
            if number == 1:
                taped = await context.ask(_SIDE)
            name = f"corner {number} of 4"
            angle = sense * ANGLE
            until = partial(_turned, left=sense * number * math.pi / 2 - turned)
            record = await context.move(MoveStep(name, CORNER, angle, -angle, 1.5 * corner, done=until, marked=True))
            turned += record.turned()
            legs.append(SteeringRun.of(record, maps))
        return Square(tuple(legs), taped, (await context.ask(_AHEAD) / 100, await context.ask(_LEFT) / 100))

    def judge(self, context: WizardContext, maps: Maps, squares: Sequence[Square]) -> Result:
        """Fit the parameters and check them."""
        chassis, geometry = context.chassis, context.config.geometry
        assert isinstance(chassis, TruckChassis)
        model = SquareModel(SteeringModel(chassis), maps, geometry.length / 2)
        check_senses(model, squares)
        fit = model.fit(squares, self.tape_error, self.string_error)
        legs = sum(len(square.legs) for square in squares)
        distance, base, offset = intervals(fit, legs + 3 * len(squares))
        distance = distance.joined(ASSUMED.floor_slip)
        base = base.joined(ASSUMED.square_linkage).joined(ASSUMED.square_on_the_spot)
        ratio = geometry.drive_ratio / distance.value
        steering = context.known.get("steering")
        estimates = [
            Estimate(
                name="drive_ratio",
                value=ratio,
                low=geometry.drive_ratio / distance.high,
                high=geometry.drive_ratio / distance.low,
                samples=len(squares),
                meaning=f"motor turns per turn of wheels of {geometry.wheel_radius:g} m; 95 % interval from tape "
                    f"and slip, and {ASSUMED.floor_slip:.1%} for other floors",
                key="geometry.drive_ratio",
            ),
            estimated(
                "wheel_radius", distance.times(geometry.wheel_radius), "m", len(squares),
                "wheel radius, at the configured gear ratio",
            ),
            estimated(
                "wheelbase",
                base.times(geometry.wheelbase),
                "m",
                legs,
                "effective wheelbase, from the turns; 95 % interval from the noise of the legs, "
                    f"{ASSUMED.square_linkage:.1%} for the linkage, and {ASSUMED.square_on_the_spot:.1%} for "
                    "steering at standstill",
                "geometry.wheelbase",
            ),
            estimated(
                "offset", offset.times(math.degrees(1.0)), "deg", legs,
                "offset of the servos, front to the left and rear to the right; 95 % interval from the "
                    "noise of the legs",
            ),
        ]  # fmt: skip
        for axle, name in enumerate(AXLES):
            scale = maps.scales[axle]
            moved = (1 if axle == 0 else -1) * math.degrees(offset.value) * scale
            common = None if steering is None else steering.estimate(f"{name}_centre")
            known = math.degrees(EYE) * abs(scale)
            if common is not None and common.low is not None and common.high is not None:
                known = (common.high - common.low) / 2
            half = math.hypot(math.degrees(offset.half) * abs(scale), known)
            centre = Interval(maps.centres[axle] - moved, half)
            text = (
                "pulse that steers straight ahead; 95 % interval from the noise of the legs and a common "
                "offset of both axles"
            )
            estimates.append(estimated(f"{name}_centre", centre, "us", legs, text, f"{STEERING}.{name}.centre_us"))
        errors = [math.hypot(*square.off) for square in squares]
        left = [math.dist(model.end(square, fit.parameters), square.off) for square in squares]
        return Result(
            wizard="odometry",
            measured=f"{len(squares)} squares of {4 * self.side + 2.8:.0f} m; ended "
            f"{', '.join(f'{100 * e:.0f}' for e in errors)} cm from the mark, residual "
            f"{100 * max(left):.0f} cm",
            estimates=tuple(estimates),
            unobserved=(
                "gear ratio and wheel radius separately",
                "equal errors of both centres: the robot crabs, and its squares still close",
                "the wheelbase separately from the servos' scale: only their product is measured",
            ),
        )


def _turned(record: MoveRecord, left: float) -> bool:
    """Return a condition that holds once the truck has turned by an angle (rad, left positive).

    The corner thus compensates for a side that was not straight.
    """
    return record.turned() * math.copysign(1.0, left) >= abs(left)


class SquareModel:
    """Model of dead reckoning on squares.

    Parameters: relative distance, relative wheelbase, and offset of the servos (rad): front to the left, rear to the
    right.

    Args:
        model: model of the truck.
        maps: servo maps used by the daemon.
        ahead: distance of the front bumper from the base (m).
    """

    def __init__(self, model: SteeringModel, maps: Maps, ahead: float) -> None:
        self._model = model
        self._maps = maps
        self._ahead = ahead

    def maps(self, offset: float) -> Maps:
        """Return the servo maps shifted by ``offset`` (rad): front to the left, rear to the right."""
        shift = math.degrees(offset)
        front, rear = (
            c - s * d for c, s, d in zip(self._maps.centres, self._maps.scales, (shift, -shift), strict=True)
        )
        return Maps((front, rear), self._maps.scales, self._maps.deficit)

    def turns(self, legs: Sequence[SteeringRun], parameters: Array) -> Array:
        """Predict the turn of each leg (rad), shape (n,)."""
        distance, base, offset = parameters
        turns, _ = self._model.predict(legs, self.maps(float(offset)))
        return np.asarray(turns * distance / base)

    def end(self, square: Square, parameters: Array) -> tuple[float, float]:
        """Predict how far the bumper is ahead and to the left of its mark at the end of a square (m)."""
        distance, base, offset = parameters.tolist()
        maps = self.maps(offset)
        chassis = self._model.chassis
        x = y = yaw = 0.0
        for leg in square.legs:
            servos = [maps.servo(axle, leg.pulses[axle]) for axle in (0, 1)]
            front, rear = self._model.axles(maps).angles(*servos)
            rolled = (
                distance
                * chassis.drivetrain.distance(leg.motor)
                / chassis.bicycle.drive_speed(np.ones_like(front), front, rear)
            )
            forward, sideways, turned = chassis.bicycle.body_twist(rolled, front, rear)
            turned = turned / base
            whole = float(turned.sum())
            heading = (
                yaw
                + (np.cumsum(turned) - turned / 2)
                + (leg.turn - whole) * (np.arange(turned.size) + 0.5) / turned.size
            )
            x += float(forward @ np.cos(heading) - sideways @ np.sin(heading))
            y += float(forward @ np.sin(heading) + sideways @ np.cos(heading))
            yaw += leg.turn
        return x + self._ahead * (math.cos(yaw) - 1.0), y + self._ahead * math.sin(yaw)

    def fit(self, squares: Sequence[Square], tape: float, string: float) -> FitResult:
        """Fit the parameters by least squares; residuals are in standard deviations, with the priors last."""
        legs = [leg for square in squares for leg in square.legs]
        turned = np.array([leg.turn for leg in legs])
        sigmas = np.array([ASSUMED.turn_of_leg(leg.sigma, self._model.distance(leg)) for leg in legs])
        sides = np.array([square.side for square in squares])
        rolled = np.array([self._model.distance(square.legs[0]) for square in squares])
        chords = np.array([sinc(square.legs[0].turn / 2) for square in squares])
        tapes = np.hypot(tape * math.sqrt(2), 0.002 * sides)
        ends = np.array([square.off for square in squares])
        place = np.hypot(ASSUMED.square_place, string * 2.0)
        believed = np.array(BELIEVED)
        start = np.array((1.0, 1.0, 0.0))

        def residual(parameters: Array) -> Array:
            back = np.array([self.end(square, parameters) for square in squares])
            return np.concatenate(
                (
                    (self.turns(legs, parameters) - turned) / sigmas,
                    (rolled * parameters[0] * chords - sides) / tapes,
                    ((back - ends) / place).ravel(),
                    (parameters - start) / believed,
                )
            )

        return least_squares(residual, start, start - 0.3, start + 0.3)


def check_senses(model: "SquareModel", squares: Sequence[Square]) -> None:
    """Reject turns opposite to the steering.

    Raises:
        InputError: the truck or an axle turned the wrong way.
    """
    legs = [leg for square in squares for leg in square.legs]
    said, turned = model.turns(legs, np.array((1.0, 1.0, 0.0))), np.array([leg.turn for leg in legs])
    share = float(said @ turned) / float(said @ said)
    if share < 0.5:  # minimum ratio of the turn by the compass to the turn by the steering
        raise InputError(
            f"the robot turned {share:.0%} as far in the corners as steered: an axle steers the wrong "
            "way, or its servo is on another channel; calibrate the steering first"
        )


def intervals(fit: FitResult, measured: int) -> tuple[Interval, Interval, Interval]:
    """Return corrections to distance and wheelbase (fractions) and the offset (rad).

    Raises:
        InputError: a correction exceeds its limit.
    """
    halves = known_errors(fit, measured - fit.parameters.size)
    if not np.isfinite(halves).all():
        raise InputError("the squares deviate by more than 30 %: calibrate drive and steering first")
    distance, base, offset = (Interval(float(x), float(h)) for x, h in zip(fit.parameters, halves, strict=True))
    return distance, base, offset
