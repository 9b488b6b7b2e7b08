"""Sign and ratio of the drive from taped distances, and the response delay of its motor.

Only motor turns per metre of floor can be measured: gear ratio and wheel radius cannot be separated. So the wizard
keeps the configured radius and fits the ratio.

Dead time and lag are fitted to the gate's commands and the motor's turns. Start and stop are fitted separately, because
drivers forward a lower speed immediately and a higher one in their next cycle.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Final, Literal, Self

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruckd.config.calibration import Estimate, Result, WizardName
from monstertruckd.tools.calibrate.assumed import ASSUMED
from monstertruckd.tools.calibrate.response import ResponseFit, Steps, unexplained
from monstertruckd.tools.calibrate.statistics import Interval, estimated, mean_interval
from monstertruckd.tools.calibrate.steps import Confirm, MoveRecord, MoveStep, Number, Plot
from monstertruckd.tools.calibrate.wizard import CLEAR, WizardContext

RATIO: Final = "geometry.drive_ratio"
INVERTED: Final = "devices.drive.driver.inverted"
RATE: Final = "devices.drive.driver.rate"
ROOM: Final = "a straight of 3 m (0.5 m of it behind the robot), 1 m wide, level"

BENT: Final = 0.35
"""Maximum turn in one run, rad: a tape measures a straight distance."""
ASIDE: Final = math.tan(BENT / 2)
"""Maximum lateral deviation of such a run, per metre of the tape."""

_FORWARD: Final = Confirm("forward", "Did the robot roll FORWARD, in the direction the lidar faces?", fact=True)
_MARK: Final = Confirm("mark", "Mark the floor vertically below the middle of the front bumper. Done?")
_DISTANCE: Final = Number(
    "distance", "Distance from that mark to the point below the middle of the front bumper now, m", 0.2, 20.0
)
_STRAIGHT: Final = Confirm(
    "straight",
    f"Did the robot end less than {100 * ASIDE:.0f} cm per metre left or right of straight ahead?",
    fact=True,
)
"""Question for a truck without a compass."""


@dataclass(frozen=True, slots=True)
class DriveWizard:
    """Wizard that determines the sign first, then drives several runs forward and back."""

    name: ClassVar[WizardName] = "drive"
    doc: ClassVar[str] = "forward direction, motor turns per metre from taped distances, and response delay"
    room: ClassVar[str] = ROOM
    runs: int = 4
    """Number of taped runs; at least 3"""
    metres: float = 2.0
    """Length of a run, m"""
    tape_error: float = 0.002
    """Standard deviation of one tape reading, m; a run has two, at its mark and at its end"""
    speed: float = 0.15

    sign_only: bool = False
    """Stop once the forward direction is known"""

    async def __call__(self, context: WizardContext) -> Result:
        """Measure."""
        inverted = bool(context.value(INVERTED))
        await context.confirm(CLEAR)
        sign = await context.move(MoveStep("10 cm, to see which direction is forward", 0.06, metres=0.15))
        if not await context.confirm(_FORWARD):
            return self._reversed(inverted)
        if self.sign_only:
            return Result(
                wizard="drive",
                measured="the robot was commanded forward and rolled forward",
                estimates=(_sign(inverted),),
                partial=True,
            )
        compass = context.config.devices.compass is not None
        if compass:
            sign.turn()  # before any taped run
        else:
            context.say(
                "no compass: the operator judges by eye whether the runs are straight, and the result is less certain"
            )
        runs, tracks = [], []
        for run in range(self.runs):
            await context.confirm(_MARK)
            speed = self.speed if run % 2 == 0 else -min(self.speed, 0.12)
            name = f"run {run + 1} of {self.runs}, {'forward' if speed > 0 else 'back'}"
            track = await context.move(MoveStep(name, speed, metres=self.metres, marked=True))
            distance = await context.ask(_DISTANCE)
            straight = None if compass else await context.confirm(_STRAIGHT)
            runs.append(TapedRun.of(track, distance, straight=straight))
            tracks.append(track)
            context.plot(_plot(runs))
        delays = context.fit("dead time and lag", lambda: drive_estimates(tracks, float(context.value(RATE))))
        result = context.fit("turns per metre", lambda: self._result(context, inverted, runs))
        context.plot(_plot(runs, result.number("turns_per_metre")))
        return result.model_copy(update={"estimates": (*result.estimates, *delays)})

    @staticmethod
    def _reversed(inverted: bool) -> Result:
        return Result(
            wizard="drive",
            measured="the robot was commanded forward and rolled backward",
            estimates=(_sign(not inverted),),
            unobserved=("the ratio: no run is driven while the sign is wrong",),
            partial=True,
            again="restart the daemon so that forward is forward, then calibrate the ratio",
        )

    def _result(self, context: WizardContext, inverted: bool, runs: list["TapedRun"]) -> Result:
        values = [run.turns / run.length for run in runs]
        middle = float(np.median(values))
        for number, value in enumerate(values, start=1):
            # 0.03: maximum relative difference of two runs; a larger one indicates a wrong reading
            if abs(value / middle - 1) > 0.03:
                off = 100 * (value / middle - 1)
                raise InputError(f"run {number} differs from the others by {off:.1f} %: measure again")
        # A compass disturbed by iron shows that the run bends, but not how much.
        known = "compass" in context.known and context.config.devices.compass is not None
        bend = 0.0 if known else max(run.bend for run in runs)
        turns = turns_per_metre(values, self.tape_error, self.metres, bend)
        radius = float(context.value("geometry.wheel_radius"))
        ratio = turns.times(2 * math.pi * radius)
        floor = (
            f"on this floor; 95 % interval from the spread of the runs, {1000 * self.tape_error:g} mm per "
            f"reading, and {ASSUMED.tape_scale:.2%} of the tape length"
            + (f", and {bend:.2%} for curved runs" if bend else "")
        )
        wheels = (
            f"motor turns per turn of wheels of {radius:g} m {floor}, {ASSUMED.floor_slip:.1%} of slip on other floors"
        )
        count = len(runs)
        estimates = [
            _sign(inverted),
            estimated("drive_ratio", on_any_floor(ratio), "", count, wheels, RATIO),
            estimated("turns_per_metre", turns, "1/m", count, f"motor turns per metre {floor}"),
        ]
        drive = context.config.devices.drive
        pulses = None if drive is None else drive.driver.encoder_pulses_per_turn
        if pulses is not None:
            ticks = turns.times(4 * pulses)
            estimates.append(estimated("ticks_per_metre", ticks, "1/m", count, f"encoder counts per metre {floor}"))
        return Result(
            wizard="drive",
            measured=f"{count} runs of about {self.metres:g} m, alternately forwards and backwards, measured with "
            "a tape",
            estimates=tuple(estimates),
            unobserved=(
                "gear ratio and wheel radius separately",
                "slip on slopes and in curves",
                "delay of the wheels behind the motor",
            ),
        )


def turns_per_metre(values: Sequence[float], tape_error: float, metres: float, bend: float) -> Interval:
    """Compute the motor turns per metre on this floor.

    Args:
        values: result of each run (1/m).
        tape_error: standard deviation of one tape reading (m).
        metres: length of a run (m).
        bend: maximum unnoticed curvature of a run, as a fraction of its length.
    """
    middle = float(np.median(values))
    found = mean_interval(values, middle * math.sqrt(2) * tape_error / metres)
    return found.joined(middle * ASSUMED.tape_scale).widened(middle * bend)


def on_any_floor(found: Interval) -> Interval:
    """Widen the interval of a value measured on one floor so that it covers other floors."""
    return found.joined(found.value * ASSUMED.floor_slip)


@dataclass(frozen=True, slots=True)
class TapedRun:
    """A run whose distance was measured with a tape."""

    turns: float
    """Turns of the motor."""
    length: float
    """Length of the arc, m."""
    bend: float
    """Length of the arc relative to the tape, minus 1."""

    @classmethod
    def of(cls, track: MoveRecord, distance: float, *, straight: bool | None = None) -> "TapedRun":
        """Compute the distance along the arc (m) from the taped chord.

        Args:
            track: record of the run.
            distance: length of the chord (m).
            straight: for a truck without a compass, whether the run looked straight to the operator: half of the
                maximum unnoticed bend is subtracted.

        Raises:
            InputError: the truck turned too far.
        """
        if straight is None:
            turn, _ = track.turn()
            if abs(turn) > BENT:
                raise InputError(
                    f"the robot turned by {math.degrees(turn):.0f} deg during the run: run `calibrate "
                    "steering --rough` first"
                )
            length = arc(distance, turn)
        elif not straight:
            raise InputError(
                f"the robot turned by more than {math.degrees(BENT):.0f} deg during the run: set the "
                "centre of its servos by hand (devices.steering.driver.front.centre_us, "
                ".rear.centre_us), because `calibrate steering` needs a compass"
            )
        else:
            length = (distance + arc(distance, BENT)) / 2
        return cls(abs(track.turns), length, length / distance - 1)


def arc(chord: float, turn: float) -> float:
    """Length of a circular arc (m), from its chord (m) and its angle (rad)."""
    half = turn / 2
    return chord * half / math.sin(half) if half else chord


def _sign(inverted: bool) -> Estimate:
    return Estimate(
        name="inverted",
        value=inverted,
        samples=1,
        meaning="driving forward needs negative rpm of the controller; confirmed by the operator",
        key=INVERTED,
    )


Part = Literal["start", "stop"]
LEAST_POSITIONS: Final = 8
"""Minimum number of motor positions from rest to half the distance, or from there to rest, to fit dead time and lag."""


@dataclass(frozen=True, slots=True)
class HalfRun:
    """First or second half of a run: from rest to half the distance, or from half the distance to rest."""

    speed: Steps
    """Commanded motor speed, rad/s."""
    times: Array
    """Times of the positions, s; (n,)."""
    positions: Array
    """Positions of the motor, rad; (n,)."""

    @classmethod
    def of(cls, record: MoveRecord, part: Part) -> Self | None:
        """Extract the half from a record; None if it contains too few positions."""
        if not record.drive_commands:
            return None
        times = np.array([reading.stamp for reading in record.drive]) / SECOND
        positions = np.array([reading.position for reading in record.drive])
        first = np.abs(positions - positions[0]) <= np.abs(positions - positions[-1])
        kept = first if part == "start" else ~first
        if int(kept.sum()) < LEAST_POSITIONS:
            return None
        sent = np.array([(command.stamp / SECOND, command.motor_velocity) for command in record.drive_commands])
        return cls(Steps.of(sent[:, 0], sent[:, 1]), times[kept], positions[kept])

    def residuals(self, delay: float, squared: float) -> Array:
        """Residuals of the positions for the best gain and origin (rad); for the arguments see ``Steps.integral``."""
        due = self.speed.integral(self.times, delay, squared)
        return unexplained(self.positions - self.positions[0], due, np.ones_like(due))


def drive_response(records: Iterable[MoveRecord], part: Part, cycle: float) -> ResponseFit:
    """Fit the response of the motor to the gate's commands.

    Args:
        records: straight runs, including the rests.
        part: first or second half of the runs.
        cycle: period at which the driver reads its commands (s).

    Raises:
        InputError: there are too few positions.
    """
    seen = [half for record in records if (half := HalfRun.of(record, part)) is not None]
    if not seen:
        raise InputError(f"{part}: no run has {LEAST_POSITIONS} readings of the drive and the gate's commands")

    def residuals(delay: float, squared: float) -> Array:
        return np.concatenate([half.residuals(delay, squared) for half in seen])

    return ResponseFit.of(residuals, cycle / 2, cycle**2 / 6)


def drive_estimates(records: Iterable[MoveRecord], rate: float) -> list[Estimate]:
    """Informational estimates for start and stop; ``rate`` is the driver's cycle rate (1/s).

    Raises:
        InputError: see ``drive_response``.
    """
    runs, found = list(records), []
    parts: tuple[tuple[Part, str], ...] = (("start", "starting"), ("stop", "stopping"))
    for part, what in parts:
        meanings = (
            f"{what}: from a command to the first change of the motor speed",
            f"{what}: time constant of the motor speed",
            f"{what}: dead time plus lag; gate.reaction has to cover it and the additional delay of the wheels",
        )
        covers = f"95 % interval from the spread of the runs and the driver's cycle of {1000 / rate:g} ms"
        found += drive_response(runs, part, 1 / rate).estimates(meanings, covers, prefix=f"{part}_")
    return found


def _plot(runs: Sequence[TapedRun], turns_per_metre: float | None = None) -> Plot:
    points = np.array([(number, run.turns / run.length) for number, run in enumerate(runs, start=1)])
    line = None if turns_per_metre is None else np.array(((1, turns_per_metre), (len(runs), turns_per_metre)))
    return Plot("turns of the motor", "run", "turns per metre", points, line)
