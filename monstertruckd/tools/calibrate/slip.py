"""Turning centres and effective wheel radii of a skid-steer body, from arcs between two rests.

A test stand, or the pose in the map, measures the body's position (``--by``). Each arc has a constant ratio of wheel
rates, so its motion is the exponential of one twist. Only wheel turns and averaged poses at rest are used, so delays
have no effect.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final, Literal

import numpy as np

from monstertruck_kinematics.chassis import Chassis
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.fitting import least_squares
from monstertruck_kinematics.identification import skid_model
from monstertruck_kinematics.se2 import integrate, to_body
from monstertruck_runtime.errors import InputError, RequestRefusedError
from monstertruck_schemas import topics
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.topics import Topic
from monstertruckd.config.calibration import Estimate, Result, WizardName
from monstertruckd.tools.calibrate.assumed import ASSUMED
from monstertruckd.tools.calibrate.statistics import known_errors
from monstertruckd.tools.calibrate.steps import MoveRecord, MoveStep, Plot
from monstertruckd.tools.calibrate.wizard import CLEAR, WizardContext

Observer = Literal["stand", "pose"]
OBSERVERS: Final[dict[Observer, Topic[Any]]] = {"stand": topics.STAND_POSE, "pose": topics.POSE}
ROOM: Final = "free floor around the robot, ten times its length across"
RADII: Final = (4.0, 2.0, 0.0)
"""Radii of the arcs, in track widths; 0: straight."""


@dataclass(frozen=True, slots=True)
class SkidArc:
    """One move between two rests."""

    left: float
    """Rotation of the left and right wheels, rad, forward positive."""
    right: float
    motion: tuple[float, float, float]
    """Motion of the body in its initial frame, m and rad."""
    sigma: tuple[float, float]
    """Standard deviations of the motion's position (m) and heading (rad)."""

    @classmethod
    def of(cls, record: MoveRecord, observer: Observer, chassis: Chassis) -> "SkidArc":
        """Create an arc from a move.

        Raises:
            InputError: there are too few poses at rest, or a shaft sent no feedback.
        """
        before, after = record.at_rest(OBSERVERS[observer])
        least = 5  # minimum number of poses at each end
        if min(len(before), len(after)) < least:
            raise InputError(f"only {len(before)} and {len(after)} poses at rest: expected {least} at each end")
        (x0, y0, yaw0), (x1, y1, yaw1) = (_mean_pose([m.pose for m in poses]) for poses in (before, after))
        moving = [m.pose.yaw for m in record.of(OBSERVERS[observer])]
        turned = float(np.unwrap(moving)[-1] - np.unwrap(moving)[0])
        turn = yaw1 - yaw0
        turn += math.tau * round((turned - turn) / math.tau)
        ahead, aside = to_body(yaw0, x1 - x0, y1 - y0)
        train = chassis.drivetrain
        rolled = [train.distance(_turned(record, i)) / train.wheel_radius for i in range(len(chassis.shafts))]
        sides = [float(np.mean(rolled[side::2])) for side in (0, 1)]
        spreads = [_spread([m.pose for m in poses]) for poses in (before, after)]
        place, heading = (math.hypot(*column) for column in zip(*spreads, strict=True))
        return cls(sides[0], sides[1], (float(ahead), float(aside), turn), (place, heading))


@dataclass(frozen=True, slots=True)
class SlipWizard:
    """Wizard that drives arcs in both directions, forward and back."""

    name: ClassVar[WizardName] = "slip"
    doc: ClassVar[str] = (
        "turning centres and wheel radii of a skid-steer body, from arcs observed by a stand or in the map"
    )
    room: ClassVar[str] = ROOM
    by: Observer = "stand"
    """Source of the robot's position: a test stand, or its own map"""
    rounds: int = 2
    """Number of times each arc is driven there and back"""
    turn: float = 2.0
    """Turn of each arc, rad"""

    async def __call__(self, context: WizardContext) -> Result:
        """Measure."""
        config = context.config
        if config.body.kind != "skid_steer":
            raise RequestRefusedError(
                Reason.NOT_SUPPORTED, f"body {config.body.kind}: slip is calibrated for a skid_steer body only"
            )
        await context.confirm(CLEAR)
        bicycle, track = context.chassis.bicycle, config.geometry.track
        speed = 0.6 * min(config.gate.speed, config.gate.reverse_speed)
        shafts = len(context.chassis.shafts)
        also = (OBSERVERS[self.by], *topics.DRIVES[1:shafts])
        arcs = []
        for share in RADII:
            for side in (1, -1) if share else (0,):
                curvature = side / (share * track) if side else 0.0
                front = math.atan(curvature * (bicycle.l_f + bicycle.l_r))
                metres = self.turn * share * track if side else 6.0 * track
                for number in range(2 * self.rounds):
                    direction = 1 if number % 2 == 0 else -1
                    side_name = {1: "left", -1: "right", 0: "straight"}[side]
                    name = f"{side_name}, {share:g} tracks, {'ahead' if direction > 0 else 'back'}"
                    # 1.5: seconds at each end: 30 poses of a stand
                    move = MoveStep(name, direction * speed, front, 0.0, metres, rest=1.5, also=also)
                    arcs.append(SkidArc.of(await context.move(move), self.by, context.chassis))
                    ends = np.array([arc.motion[:2] for arc in arcs])
                    context.plot(Plot("ends of the arcs", "ahead of the start (m)", "left of the start (m)", ends))
        return context.fit("turning centres", lambda: result_of(arcs, config.geometry.wheel_radius, track / 2))


def result_of(arcs: Sequence[SkidArc], radius: float, half_track: float) -> Result:
    """Fit the parameters and check them.

    Args:
        arcs: driven arcs.
        radius: nominal wheel radius (m).
        half_track: half the track width (m).

    Raises:
        InputError: there are too few arcs, or none in one direction.
    """
    turns = np.array([arc.motion[2] for arc in arcs])
    if len(arcs) < 4 or not ((turns > 0.3).any() and (turns < -0.3).any()):
        raise InputError(f"{len(arcs)} arcs: expected at least 4, in both directions")
    model = skid_model("icr and slip", radius, half_track, bounded=False, with_icr_x=True)
    seen = np.array([arc.motion for arc in arcs]).T
    distances = np.array([radius * max(abs(arc.left), abs(arc.right)) for arc in arcs])
    place = np.hypot([max(arc.sigma[0], ASSUMED.rest_position) for arc in arcs], ASSUMED.sliding * distances)
    heading = np.hypot([max(arc.sigma[1], ASSUMED.rest_heading) for arc in arcs], ASSUMED.sliding * np.abs(turns))
    left, right = np.array([(arc.left, arc.right) for arc in arcs]).T
    _check_sides(left, right, seen)

    def residual(values: Array) -> Array:
        vx, vy, wz = model.build(values).forward((left, right))
        zero = np.zeros_like(left)
        x, y, yaw = integrate((zero, zero, zero), vx, vy, wz, 1.0)
        off = np.array((x, y, yaw)) - seen
        return np.asarray((off / (place, place, heading)).ravel())

    fit = least_squares(residual, model.start, model.lower, model.upper)
    halves = known_errors(fit, fit.residuals.size - fit.parameters.size)
    if not np.isfinite(halves).all():
        raise InputError("the arcs do not determine all turning centres: drive more arcs with several radii")
    values = dict(zip(model.parameters, fit.parameters.tolist(), strict=True))
    errors = dict(zip(model.parameters, halves.tolist(), strict=True))
    tilt = math.sqrt(values["slip_ratio"])
    share = math.hypot(errors["gain"] / values["gain"], errors["slip_ratio"] / values["slip_ratio"] / 2)
    gains = {"gain_left": values["gain"] / tilt, "gain_right": values["gain"] * tilt}
    rows = [(name, values[name], errors[name], math.inf, "m") for name in ("icr_left", "icr_right")]
    # The turning centre of a real body is not ahead of its base; an apparent lead within the error is measurement
    # error.
    most = 0.0 if values["icr_x"] <= errors["icr_x"] else math.inf
    rows.append(("icr_x", values["icr_x"], errors["icr_x"], most, "m"))
    rows += [(name, value, share * value, math.inf, "") for name, value in gains.items()]
    meanings = {
        "icr_left": "turning centre of the left wheels, left of the middle",
        "icr_right": "turning centre of the right wheels",
        "icr_x": "turning centres, ahead of the middle",
        "gain_left": "effective over nominal radius of the left wheels",
        "gain_right": "effective over nominal radius of the right wheels",
    }
    return Result(
        wizard="slip",
        measured=f"{len(arcs)} arcs between rests; residuals {fit.rms:.2f} times the expected noise",
        estimates=tuple(
            Estimate(
                name=name,
                value=min(value, most),
                low=value - half,
                high=min(value + half, most),
                unit=unit,
                samples=len(arcs),
                meaning=f"{meanings[name]}, on this floor; 95 % interval from poses and skidding",
                key=f"body.{name}",
            )
            for name, value, half, most, unit in rows
        ),
        unobserved=("another floor, another load", "rotation of the body when the wheels reverse, and slow sliding"),
    )


def _check_sides(left: Array, right: Array, seen: Array) -> None:
    """Raise InputError if the sides are swapped or one of them turns in the wrong direction.

    Raises:
        InputError: the sides are swapped, or one is reversed; the message says which.
    """
    ahead, turned = np.sign(seen[0]), seen[2]
    sides = {"left": float(ahead @ left), "right": float(ahead @ right)}
    wrong = [name for name, sense in sides.items() if sense < 0.0]
    if wrong:
        raise InputError(
            f"the {' and '.join(wrong)} wheels count backwards while the body moves ahead: invert their sign"
        )
    if float((right - left) @ turned) < 0.0:
        raise InputError("the body turns left when the left wheels are faster: left and right are swapped")


def _turned(record: MoveRecord, shaft: int) -> float:
    readings = record.drive if shaft == 0 else record.of(topics.DRIVES[shaft])
    if len(readings) < 2:
        raise InputError(f"shaft {shaft + 1} sent no feedback")
    return readings[-1].position - readings[0].position


def _mean_pose(poses: Sequence[Pose2D]) -> tuple[float, float, float]:
    yaws = np.unwrap([pose.yaw for pose in poses])
    return float(np.mean([p.x for p in poses])), float(np.mean([p.y for p in poses])), float(yaws.mean())


def _spread(poses: Sequence[Pose2D]) -> tuple[float, float]:
    """Standard errors of a mean pose (m and rad)."""
    root = math.sqrt(len(poses))
    place = math.hypot(float(np.std([p.x for p in poses])), float(np.std([p.y for p in poses]))) / math.sqrt(2)
    return place / root, float(np.unwrap([p.yaw for p in poses]).std()) / root
