"""Centre, direction, travel and pulse map of both steering servos.

Hobby servos have no feedback, so the motion of the truck is the measurement: the compass measures its turn, the drive
its distance, and a string on the floor reveals what neither can measure: crabbing, when both axles are off by the same
angle.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import ClassVar, Final

import numpy as np

from monstertruck_drivers.os4000.config import IronConfig, Os4000Config
from monstertruck_kinematics.chassis import TruckChassis
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.fitting import FitResult
from monstertruck_runtime.errors import InputError, RequestRefusedError
from monstertruck_schemas.reasons import Reason
from monstertruckd.config.calibration import Estimate, Result, WizardName
from monstertruckd.config.wizards import STEERING
from monstertruckd.tools.calibrate.assumed import ASSUMED
from monstertruckd.tools.calibrate.statistics import NORMAL, Interval, estimated
from monstertruckd.tools.calibrate.steering_model import AXLES, Maps, SteeringModel, SteeringRun, half_widths
from monstertruckd.tools.calibrate.steps import Confirm, MoveStep, Number, Plot
from monstertruckd.tools.calibrate.weave import estimates, response, weaves
from monstertruckd.tools.calibrate.wizard import CLEAR, WizardContext

FULL: Final = 0.12
"""Speed of full circles (m/s)."""
ROOM: Final = "2.5 m x 2.5 m, level, the robot in the middle; with --rough 1.5 m x 1.5 m"

ROUGH: Final = (0.06, 0.1, 0.4)
"""Speed (m/s), axle angle (rad) and distance (m) of the first arcs: even if the truck turns the wrong way, the turn is
too small for the gate to report dead steering.
"""

DEAD_BAND: Final = 2.0
"""Maximum distance between a servo's final position and its set-point, us of pulse."""
BAND: Final = NORMAL * DEAD_BAND / math.sqrt(3)
"""Dead band of the servo, as half a 95 % interval, us."""
SPAN: Final = 50.0
"""Angle of the servo between full circles to the left and to the right, degrees."""
SHORT: Final = math.radians(2.0)
"""Shortfall of the servo angle above which a mechanical stop is assumed, rad; circles keep this distance from the
ends.
"""

_TURNED: Final = Confirm(
    "turned", "The robot steered left and drove ahead: did it turn LEFT, seen from above?", fact=True
)
_STRING: Final = Confirm(
    "string", "Lay a string along the robot's left side and 2.5 m ahead, and mark the middle of that side on it. Done?"
)
_OFFSET: Final = Number(
    "offset", "How far is the middle of the left side from the string now, cm (left positive)?", -60.0, 60.0
)
SIDES: Final = ((1, "left"), (-1, "right"))
CIRCLED: Final = (("the front", (1, 0)), ("the rear", (0, 1)), ("all", (1, -1)))
"""Axles used for full circles, with the steering direction of each."""


@dataclass(frozen=True, slots=True)
class SteeringWizard:
    """Wizard that drives short arcs to find directions, then measures travel, straights, full circles and weaves."""

    name: ClassVar[WizardName] = "steering"
    doc: ClassVar[str] = "centre, direction, travel and pulses of both axles, from the robot's turns and a string"
    room: ClassVar[str] = ROOM
    rough: bool = False
    """Determine directions and rough centres only, before the compass is calibrated"""
    strings: int = 3
    """Straight runs along a string; 0 without a string"""
    string_error: float = ASSUMED.string_direction
    """Standard deviation of the string's direction along the truck, rad: 1.4 mm on 0.4 m"""
    weaves: int = 3
    """Number of weaves ahead and back, for dead time and lag"""

    @property
    def moves(self) -> int:
        """Number of moves: either arcs only, or arcs, travel, straights, circles and weaves."""
        arcs = 2 * len(SIDES) * len(AXLES)
        return arcs if self.rough else 3 * arcs + 2 * self._lines + len(CIRCLED) * len(SIDES) + 2 * self.weaves

    @property
    def _lines(self) -> int:
        return max(self.strings, 2)

    async def __call__(self, context: WizardContext) -> Result:
        """Measure."""
        chassis = context.chassis
        if not isinstance(chassis, TruckChassis):
            raise RequestRefusedError(Reason.NOT_SUPPORTED, "only the truck's two steered axles can be calibrated")
        maps, model = Maps.of(context.config), SteeringModel(chassis)
        await context.confirm(CLEAR)
        context.expect(self.moves)
        arcs = await self._arcs(context, maps, ROUGH)
        directions = context.fit("directions", lambda: steered_senses(arcs))
        start = Maps(maps.centres, (maps.scales[0] * directions[0], maps.scales[1] * directions[1]), maps.deficit)
        wrong = [name for name, sign in zip(AXLES, directions, strict=True) if sign < 0]
        if self.rough or wrong:
            senses = (
                f"the {' and '.join(wrong)} wheels steered opposite to the configured direction; the "
                "calibration corrects this"
            )
            again = f"restart the daemon and run the wizard again: {senses}"
            if len(wrong) == len(AXLES):
                await self._check_compass(context)
                again += "; swapped cables look the same: do the FRONT wheels turn when the front axle is steered?"
            return context.fit("centres", lambda: _rough(arcs, model, start, again if wrong else None))
        legs = [leg for axle in await self._arcs(context, maps, (0.12, 0.18, 1.0)) for leg in axle]
        first = Maps.from_parameters(model.fit([*arcs[0], *arcs[1], *legs], start).parameters)
        travel = await self._travel(context, maps, model, first)
        legs += await self._straights(context, maps)
        legs += await self._circles(context, maps, model, first, travel)
        weaving = [await context.move(move) for move in weaves(self.weaves)]
        compass = context.config.devices.compass
        settings = None if compass is None else compass.driver
        iron = settings.iron if isinstance(settings, Os4000Config) else IronConfig()
        answer = context.fit("dead time and lag", lambda: response(weaving, chassis, iron))
        fit = context.fit("pulse maps", lambda: model.fit(legs, first))
        context.plot(turns_plot(legs, model, Maps.from_parameters(fit.parameters)))
        result = context.fit("intervals", lambda: self._result(context, model, legs, fit, travel))
        return result.model_copy(update={"estimates": (*result.estimates, *estimates(answer))})

    # Driving

    @staticmethod
    async def _check_compass(context: WizardContext) -> None:
        """Ask the operator whether the compass is wrong, because it reports that both axles steer the wrong way.

        Raises:
            InputError: the compass is wrong.
        """
        speed, angle, metres = ROUGH
        await context.move(
            MoveStep("front wheels left again, to see the direction of the turn", speed, angle, 0.0, metres)
        )
        if await context.confirm(_TURNED):
            raise InputError(
                "the robot turns as steered but the compass reports the opposite: the compass is upside "
                "down, or its heading has the wrong sign; nothing was saved"
            )

    @staticmethod
    async def _arcs(
        context: WizardContext, maps: Maps, arc: tuple[float, float, float]
    ) -> tuple[list[SteeringRun], list[SteeringRun]]:
        """Drive arcs in both directions, forward and back, first with the front axle and then with the rear axle."""
        speed, angle, metres = arc
        found: tuple[list[SteeringRun], list[SteeringRun]] = ([], [])
        for axle, name in enumerate(AXLES):
            for sign, side in SIDES:
                for direction in (1, -1):
                    what = f"{name} wheels {side}, {'forward' if direction > 0 else 'back'}"
                    front, rear = _steered(axle, sign * angle)
                    track = await context.move(MoveStep(what, direction * speed, front, rear, metres))
                    found[axle].append(SteeringRun.of(track, maps))
        return found

    @staticmethod
    async def _travel(context: WizardContext, maps: Maps, model: SteeringModel, first: Maps) -> "list[AxleTravel]":
        """Find how far each axle follows its commands to each side."""
        speed, metres = (0.1, 0.6)  # speed and length of arcs with the wheels as far over as the gate allows
        limit = context.config.gate.angle
        reached = []
        for axle, name in enumerate(AXLES):
            for sign, side in SIDES:
                front, rear = _steered(axle, sign * limit)
                legs = []
                for direction in (1, -1):
                    move = MoveStep(f"{name} wheels fully {side}", direction * speed, front, rear, metres)
                    legs.append(SteeringRun.of(await context.move(move), maps))
                reached.append(AxleTravel.of(axle, sign, legs, model, first))
        return reached

    async def _straights(self, context: WizardContext, maps: Maps) -> list[SteeringRun]:
        """Drive straight ahead and back, approaching the straight position from the left and from the right."""
        speed, metres = (0.12, 2.0)  # m/s, m
        legs = []
        approach = 0.2
        for run in range(self._lines):
            side = approach if run % 2 == 0 else -approach
            if self.strings:
                await context.confirm(_STRING)
            ahead = MoveStep("straight ahead", speed, metres=metres, approach=side, marked=bool(self.strings))
            track = await context.move(ahead)
            offset = await context.ask(_OFFSET) / 100 if self.strings else None
            sigma = math.hypot(self.string_error * metres, 0.003)
            legs.append(SteeringRun.of(track, maps, offset, sigma))
            back = await context.move(MoveStep("straight back", -speed, metres=metres, approach=-side))
            legs.append(SteeringRun.of(back, maps))
        return legs

    @staticmethod
    async def _circles(
        context: WizardContext, maps: Maps, model: SteeringModel, first: Maps, travel: "list[AxleTravel]"
    ) -> list[SteeringRun]:
        """Drive a full turn in each direction with each axle and with both; slow compass errors cancel.

        The wheels are turned as far as they follow their commands; the ``first`` maps give the command.
        """
        ends = {(reach.axle, reach.sign): reach.sign * (abs(reach.servo) - SHORT) for reach in travel}
        legs = []
        for wheels, steered in CIRCLED:
            for sign, side in SIDES:
                servos = [ends.get((axle, sign * sense), 0.0) for axle, sense in enumerate(steered)]
                front, rear = model.commands(servos, first, maps)
                move = MoveStep(
                    f"a full circle with {wheels} wheels, {side}",
                    FULL,
                    front,
                    rear,
                    2.6 * math.pi / abs(context.chassis.bicycle.curvature(front, rear)),
                    done=lambda track: abs(track.turned()) > 2 * math.pi,
                )
                legs.append(SteeringRun.of(await context.move(move), maps))
        return legs

    # Judging

    def _result(
        self,
        context: WizardContext,
        model: SteeringModel,
        legs: list[SteeringRun],
        fit: FitResult,
        travel: "list[AxleTravel]",
    ) -> Result:
        maps = Maps.from_parameters(fit.parameters)
        travel = [AxleTravel.of(reach.axle, reach.sign, reach.legs, model, maps) for reach in travel]
        # 0.003: relative error of a taped wheelbase
        halves, share = half_widths(fit), _distance_error(context) + 0.003
        eye = "" if self.strings else "; errors common to both axles are determined by eye and from circles only"
        band = f"95 % interval from the noise of the legs and the servo's dead band of {DEAD_BAND:g} us"
        estimates: list[Estimate] = []
        for axle, name in enumerate(AXLES):
            centre, scale = (float(value) for value in fit.parameters[2 * axle : 2 * axle + 2])
            centre_half, scale_half = (float(value) for value in halves[2 * axle : 2 * axle + 2])
            estimates += [
                _direction(name, scale, len(legs)),
                _centre(name, centre, math.hypot(centre_half, BAND), len(legs), band + eye),
                Estimate(
                    name=f"{name}_scale",
                    value=abs(scale),
                    low=abs(scale) * (1 - share) - math.hypot(scale_half, BAND / SPAN),
                    high=abs(scale) * (1 + share) + math.hypot(scale_half, BAND / SPAN),
                    unit="us/deg",
                    samples=len(legs),
                    meaning=f"pulse per degree of the servo; {band}, and {share:.1%} for distance and wheelbase",
                    key=f"{STEERING}.{name}.scale_us_per_deg",
                ),
            ]
            before = context.known.get("steering")
            for reach in travel:
                if reach.axle == axle:
                    estimates += reach.estimates(name, centre, scale, before)
        estimates += _deficits(maps, halves[4:], len(legs), band)
        strings = f"along {self.strings} strings" if self.strings else "without a string"
        return Result(
            wizard="steering",
            measured=f"{len(legs)} legs: arcs with one axle, full circles with one and both axles, straights {strings}",
            estimates=tuple(estimates),
            unobserved=(
                "the wheelbase (its error appears as a scale error), and the linkage except for its "
                "measured lack of turning",
                "travel beyond the limits of the gate and the servo",
                "an error of devices.compass.driver.delay, which appears as dead time of the steering",
                *(
                    ()
                    if self.strings
                    else ("equal errors of both centres, except through unequal circles: the robot crabs",)
                ),
            ),
        )


@dataclass(frozen=True, slots=True)
class AxleTravel:
    """How far an axle steers to one side."""

    axle: int
    sign: int
    """Side: +1 left, -1 right."""
    servo: float
    """Servo angle reached, rad."""
    axle_angle: float
    """Axle angle at this servo angle, rad."""
    stopped: bool
    """Whether a mechanical stop ended the travel before the set-point."""

    half: float
    """Half the 95 % interval of the axle angle, rad."""
    legs: tuple[SteeringRun, ...]
    """Arcs with the wheels far over."""

    @classmethod
    def of(cls, axle: int, sign: int, legs: Sequence[SteeringRun], model: SteeringModel, maps: Maps) -> "AxleTravel":
        """Compute the travel from arcs at large steering angles; ``maps`` give the angle of the other axle."""
        reached, meant = np.array([model.reached(leg, maps, axle) for leg in legs]).mean(axis=0).tolist()
        stopped = sign * (meant - reached) > SHORT
        servo = reached if stopped else meant
        angle = model.axle_angle(axle, servo, maps)
        noise = max(ASSUMED.turn_of_leg(leg.sigma, model.distance(leg)) / abs(leg.turn) for leg in legs)
        # 0.02: relative error of the scale from short arcs
        half = abs(angle) * (NORMAL * noise / math.sqrt(len(legs)) + 0.02)
        return cls(axle, sign, servo, angle, stopped, half, tuple(legs))

    def estimates(self, name: str, centre: float, scale: float, before: Result | None) -> list[Estimate]:
        """Description of the travel, and the pulse limit (us) if there is a mechanical stop.

        A pulse limit set ``before`` keeps the axle from reaching the stop, so it is kept.
        """
        side, end = "left" if self.sign > 0 else "right", "max_us" if self.sign * scale > 0 else "min_us"
        value, half = math.degrees(self.axle_angle), math.degrees(self.half)
        travel = Estimate(
            name=f"{name}_{side}_travel",
            value=value,
            low=value - half if self.stopped else None,
            high=value + half if self.stopped else None,
            unit="deg",
            samples=2,
            meaning="axle angle at which the wheels reach a mechanical stop; 95 % interval from the noise of the "
            "legs and 2 % of scale"
            if self.stopped
            else "maximum axle angle that the wheels reached; gate and servo limit it further",
        )
        limit = None if before is None else before.estimate(f"{name}_{end}")
        margin = 1.0  # distance kept from a stop, degrees of servo angle: a servo that pushes against a stop burns out
        if self.stopped:
            degrees = math.degrees(self.servo) - self.sign * margin
            limit = Estimate(
                name=f"{name}_{end}",
                value=centre + scale * degrees,
                unit="us",
                samples=2,
                meaning=f"limit of the pulse, {margin:g} deg of servo angle before the stop",
                key=f"{STEERING}.{name}.{end}",
            )
        return [travel] if limit is None else [travel, limit]


def turns_plot(legs: Sequence[SteeringRun], model: SteeringModel, maps: Maps) -> Plot:
    """Plot the turns of all legs as measured by the compass against those predicted by the pulse maps."""
    turns, _ = model.predict(legs, maps)
    points = np.degrees(np.column_stack((turns, [leg.turn for leg in legs])))
    same = np.repeat(np.array((points.min(), points.max()))[:, None], 2, axis=1)
    return Plot("turns of all legs", "by the pulse maps (deg)", "by the compass (deg)", points, same)


def _steered(axle: int, angle: float) -> tuple[float, float]:
    """Angles of the front and rear axle (rad) if only one of them is steered."""
    return (angle, 0.0) if axle == 0 else (0.0, angle)


def steered_senses(arcs: tuple[list[SteeringRun], list[SteeringRun]]) -> tuple[int, int]:
    """Return for each axle +1 if it steers as commanded, -1 if it steers in the opposite direction.

    Raises:
        InputError: an axle does not turn the truck.
    """
    signs = []
    for axle, legs in enumerate(arcs):
        # Left forward, left back, right forward, right back: the part common to both sides is the centre error.
        pattern = np.array((1, -1, -1, 1)) * (1 if axle == 0 else -1)
        turn = float(pattern @ [leg.turn for leg in legs]) / 4
        error = math.hypot(*(leg.sigma for leg in legs)) / 4
        if abs(turn) < 5.0 * error:  # number of standard errors of a turn that make its direction certain
            raise InputError(
                f"{AXLES[axle]} wheels: steering them turned the robot by only {math.degrees(turn):.2f} "
                "deg: check the servo's supply and channel"
            )
        signs.append(1 if turn > 0 else -1)
    return signs[0], signs[1]


def _rough(
    arcs: tuple[list[SteeringRun], list[SteeringRun]], model: SteeringModel, start: Maps, again: str | None
) -> Result:
    """Directions and rough centres, used before compass and drive are calibrated.

    Args:
        arcs: driven arcs.
        model: model of the truck.
        start: configured maps with the measured directions.
        again: remaining steps.
    """
    legs = [*arcs[0], *arcs[1]]
    fit = model.fit(legs, start)
    halves = half_widths(fit)
    estimates = []
    unscaled = 0.5  # relative error of a turn before compass and drive are calibrated
    for axle, name in enumerate(AXLES):
        centre, scale = (float(value) for value in fit.parameters[2 * axle : 2 * axle + 2])
        half = float(halves[2 * axle]) + unscaled * abs(centre - start.centres[axle])
        meaning = (
            f"rough: 95 % interval from the noise of the legs, and {unscaled:.0%} of the correction for "
            "compass and drive"
        )
        estimates += [_direction(name, scale, len(legs)), _centre(name, centre, half, len(legs), meaning)]
    return Result(
        wizard="steering",
        measured=f"{len(legs)} short arcs, one axle at a time",
        estimates=tuple(estimates),
        unobserved=("pulse per degree and travel", "equal errors of both centres, except by eye"),
        partial=True,
        again=again,
    )


def _direction(name: str, scale: float, samples: int) -> Estimate:
    return Estimate(
        name=f"{name}_direction",
        value=1 if scale > 0 else -1,
        samples=samples,
        meaning="+1: a longer pulse steers left; found from the direction in which the robot turned",
        key=f"{STEERING}.{name}.direction",
    )


def _centre(name: str, centre: float, half: float, samples: int, meaning: str) -> Estimate:
    meaning, key = f"pulse that steers straight ahead; {meaning}", f"{STEERING}.{name}.centre_us"
    return estimated(f"{name}_centre", Interval(centre, half), "us", samples, meaning, key)


def _deficits(maps: Maps, halves: Array, samples: int, band: str) -> list[Estimate]:
    """Estimates of the turn deficit.

    Args:
        maps: fitted maps.
        halves: half-widths of the 95 % intervals, shape (6,).
        samples: number of legs.
        band: coverage of the intervals.
    """
    return [
        estimated(
            f"deficit_{name}", Interval(value, float(half)), "", samples,
            f"turns fall short of the linkage by this share, {name.replace('_', ' ')}; {band}",
            f"body.turn_deficit.{name}",
        )
        for (name, value), half in zip(asdict(maps.deficit).items(), halves, strict=True)
    ]  # fmt: skip


def _distance_error(context: WizardContext) -> float:
    """Relative error of the measured distance."""
    drive = context.known.get("drive")
    ratio = None if drive is None else drive.estimate("turns_per_metre")
    if ratio is None or ratio.low is None or ratio.high is None:
        return 0.02  # relative error of the distance while the drive is not calibrated
    return (ratio.high - ratio.low) / 2 / float(ratio.value)
