"""Zero and direction of the two servos below the lidar, by the height of its beam and by its view of the floor.

The levelling runs as always: it turns the joints against the tilt that the compass measures. On a level floor the
height of the beam at its window, on a wall ahead and on one to the left gives the tilt of the lidar; minus the tilt of
the body it is the true angle of the joints, so the positions of their servos give the zeros. On blocks a joint that
turns the right way keeps the lidar level, and one that turns the wrong way doubles the body's tilt: then the beam meets
the floor at the distance of twice the tilt. A joint that does not turn leaves it single, as do two that are swapped.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from monstertruck_drivers.ax12.config import Ax12Config, JointConfig
from monstertruck_drivers.ax12.protocol import STEP
from monstertruck_estimation.scan_tilt import plane_slopes
from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.errors import InputError, RequestRefusedError
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import Attitude, LaserScan, StabiliserFeedback
from monstertruckd.config.calibration import Estimate, Result, WizardName
from monstertruckd.config.wizards import STABILISER
from monstertruckd.tools.calibrate.assumed import ASSUMED
from monstertruckd.tools.calibrate.beams import bearings_of, stacked_ranges
from monstertruckd.tools.calibrate.lidar import HEIGHTS, beam_distance, beam_tilt
from monstertruckd.tools.calibrate.statistics import NORMAL, Interval
from monstertruckd.tools.calibrate.steps import Collect, Confirm, Plot
from monstertruckd.tools.calibrate.wizard import WizardContext

ROOM: Final = (
    "a level floor, a wall 2.5 to 3.5 m ahead of the robot and one to its left, nothing within 2.5 m ahead and to the "
    "right; two blocks, 4 to 6 cm high"
)
BLOCKS: Final = (math.radians(4.0), math.radians(15.0))
"""Tilt range of a body on blocks (rad)."""
FOLLOWS: Final = math.radians(2.0)
"""Maximum difference between a following joint and the tilt that it compensates, rad."""
SECTOR: Final = math.radians(20.0)
"""Half angle of the sector where a tilted lidar meets the floor."""
JOINTS: Final = ("pitch", "roll")

_LEVEL: Final = Confirm("level", "Stand the robot on the level floor, wheels straight, and let go. Done?")
_NOSE: Final = Confirm("nose", "Put the rear wheels on blocks, so that the nose is low, and let go. Done?")
_SIDE: Final = Confirm("side", "Put the left wheels on blocks instead, so that the right side is low. Done?")


class RollPitch(NamedTuple):
    """Two angles, rad, REP 103: pitch nose down, roll right side down positive."""

    pitch: float
    roll: float


@dataclass(frozen=True, slots=True)
class RestMeasurement:
    """Measurements while the truck stood."""

    body: RollPitch
    """Tilt of the body by the compass"""
    joints: RollPitch
    """Joint angles reported by the driver"""
    angles: Array
    """Angles of the beams, rad, left positive; (n,)"""
    ranges: Array
    """Medians, m; inf = nothing; (n,)"""

    @classmethod
    def of(
        cls, scans: Sequence[LaserScan], tilts: Sequence[Attitude], joints: Sequence[StabiliserFeedback]
    ) -> "RestMeasurement":
        """Build it from messages.

        Raises:
            InputError: a servo does not answer.
        """
        read = [(j.pitch, j.roll) for j in joints if j.pitch is not None and j.roll is not None]
        if len(read) < len(joints) / 2:
            raise InputError("a servo of the stabiliser does not answer")
        pitch, roll = np.mean(np.array(read), axis=0).tolist()
        ranges, angles = stacked_ranges(scans, np.inf), bearings_of(scans[0])
        body = RollPitch(float(np.mean([a.pitch for a in tilts])), float(np.mean([a.roll for a in tilts])))
        return cls(body, RollPitch(pitch, roll), angles, np.median(ranges, axis=0))


@dataclass(frozen=True, slots=True)
class Heights:
    """Heights of the beam over the floor (m)."""

    centre: float
    ahead: float
    left: float


@dataclass(frozen=True, slots=True)
class StabiliserWizard:
    """Heights on the level floor; then blocks below the rear wheels, and below the left ones."""

    name: ClassVar[WizardName] = "stabiliser"
    doc: ClassVar[str] = "zero and direction of both servos, from the height of the beam and blocks under wheels"
    room: ClassVar[str] = ROOM
    tape_error: float = ASSUMED.tape_reading
    """Standard deviation of a height, m"""

    async def __call__(self, context: WizardContext) -> Result:
        """Measure."""
        device = context.config.devices.stabiliser
        if device is None or context.config.devices.compass is None or context.config.devices.lidar is None:
            raise RequestRefusedError(Reason.NOT_SUPPORTED, "calibrating a stabiliser needs a compass and a lidar")
        await context.confirm(_LEVEL)
        flat, scans = await self._stand(context)
        ahead, left = (beam_distance(scans, angle) for angle in (0.0, math.pi / 2))
        asked = [(await context.ask(step)) / 100 for step in HEIGHTS]
        beam_tilt(asked, (ahead, left))
        heights = Heights(*asked)
        await context.confirm(_NOSE)
        nose, _ = await self._stand(context)
        await context.confirm(_SIDE)
        side, _ = await self._stand(context)
        walls = ahead, left
        stands = [(s.body[axis], s.joints[axis]) for s in (flat, nose, side) for axis in (0, 1)]
        points = np.degrees(np.array(stands))
        level = np.outer((points[:, 0].min(), points[:, 0].max()), (1.0, -1.0))
        context.plot(Plot("joints that level the lidar", "tilt of the body (deg)", "joint (deg)", points, level))
        return context.fit(
            "zeros and directions", lambda: result_of(flat, nose, side, heights, walls, device.driver, self.tape_error)
        )

    @staticmethod
    async def _stand(context: WizardContext) -> tuple[RestMeasurement, list[LaserScan]]:
        await context.collect(Collect("the robot comes to rest", topics.SCAN, 20))
        scans = await context.collect(Collect("what the lidar sees", topics.SCAN, 10))
        tilts = await context.collect(Collect("the robot's tilt", topics.COMPASS, 20))
        joints = await context.collect(Collect("positions of the servos", topics.STABILISER, 20))
        return RestMeasurement.of(scans, tilts, joints), scans


def result_of(
    flat: RestMeasurement,
    nose: RestMeasurement,
    side: RestMeasurement,
    heights: Heights,
    walls: tuple[float, float],
    settings: Ax12Config,
    tape_error: float,
) -> Result:
    """Judge.

    Args:
        flat: on the level floor.
        nose: with the nose low.
        side: with the right side low.
        heights: heights of the beam.
        walls: distances of the wall ahead and of the one to the left, m.
        settings: that the daemon runs with.
        tape_error: standard deviation of a height, m.

    Raises:
        InputError: heights that no lidar has; the blocks are missing, a joint does not follow, or the scans fit neither
            direction.
    """
    lies = RollPitch(*beam_tilt((heights.centre, heights.ahead, heights.left), walls))
    really = RollPitch(lies.pitch - flat.body.pitch, lies.roll - flat.body.roll)
    joints = (settings.pitch, settings.roll)
    changes = [_turns(stand, flat, heights.centre, axis, really) for axis, stand in enumerate((nose, side))]
    estimates: list[Estimate] = []
    for axis, (name, joint, change) in enumerate(zip(JOINTS, joints, changes, strict=True)):
        direction = joint.direction * change
        position = joint.zero + joint.direction * flat.joints[axis] / STEP
        # 0.3: standard deviation of a unit's position reading, steps: uniform over a step
        zero = Interval(
            position - direction * really[axis] / STEP,
            NORMAL * math.hypot(ASSUMED.beam_angle(tape_error, walls[axis]) / STEP, 0.3),
        )
        _check_range(name, joint, zero.value)
        estimates += [
            Estimate(
                name=f"{name}_zero",
                value=round(zero.value),
                low=zero.low,
                high=zero.high,
                unit="steps",
                samples=2,
                meaning=f"position at which the lidar is parallel to the body; 95 % of two heights {walls[axis]:.1f} m "
                "apart, and of the compass's tilt",
                key=f"{STABILISER}.{name}.zero",
            ),
            Estimate(
                name=f"{name}_direction",
                value=direction,
                samples=1,
                meaning="+1: a rising position turns the joint positively; by the floor that the lidar sees, or not",
                key=f"{STABILISER}.{name}.direction",
            ),
        ]
    turned = [name for name, change in zip(JOINTS, changes, strict=True) if change < 0]
    again = f"{' and '.join(turned)} turned the wrong way: restart the daemon, and look whether the lidar is level then"
    return Result(
        wizard="stabiliser",
        measured=f"heights of the beam; blocks of {math.degrees(nose.body.pitch):.0f} and "
        f"{math.degrees(side.body.roll):.0f} deg",
        estimates=tuple(estimates),
        unobserved=("a lidar that sits askew on its mount: it looks like a zero that is off",),
        again=again if turned else None,
    )


def _turns(stand: RestMeasurement, flat: RestMeasurement, height: float, axis: int, really: RollPitch) -> int:
    """+1 if a joint turns as its driver reports, -1 if it turns the other way.

    Raises:
        InputError: see ``result_of``.
    """
    name, low = JOINTS[axis], ("nose", "right side")[axis]
    tilt = stand.body[axis]
    if not BLOCKS[0] <= tilt <= BLOCKS[1]:
        raise InputError(
            f"the {low} is {math.degrees(tilt):.1f} deg low: expected {math.degrees(BLOCKS[0]):.0f} to "
            f"{math.degrees(BLOCKS[1]):.0f}; use other blocks"
        )
    moved = [s - f for s, f in zip(stand.joints, flat.joints, strict=True)]
    if abs(moved[axis] + tilt - flat.body[axis]) > FOLLOWS:
        raise InputError(
            f"the {name} joint stands at {math.degrees(stand.joints[axis]):.0f} deg where "
            f"{math.degrees(-tilt):.0f} would level the lidar: it does not follow; see `status` for the stabiliser"
        )
    direction = (0.0, -math.pi / 2)[axis]

    def lidar(turn: Callable[[RollPitch], RollPitch]) -> RollPitch:
        offset = turn(RollPitch(moved[0], moved[1]))
        return RollPitch(really.pitch + offset.pitch, really.roll + offset.roll)

    wrong = lidar(lambda m: RollPitch(-m.pitch, m.roll) if axis == 0 else RollPitch(m.pitch, -m.roll))
    swapped = (lidar(lambda m: RollPitch(m.roll, m.pitch)), lidar(lambda m: RollPitch(-m.roll, -m.pitch)))
    loose = lidar(lambda _: RollPitch(0.0, 0.0))

    def seen(joints: RollPitch) -> float | None:
        return _on_floor(stand, flat, joints, height, direction)

    turned, leaning = seen(wrong), seen(loose)
    if turned is None or leaning is None:
        raise InputError(
            f"with the {low} low a lidar that leans would see the floor hardly nearer than what stands there: higher "
            "blocks, or more room"
        )
    most = 0.6  # share of the beams of the sector that must be on the floor, for the lidar to look there
    if turned > most:
        return -1
    if leaning > most:
        raise InputError(f"with the {low} low the lidar leans with the body: the horn of the {name} joint is loose")
    if max(seen(joints) or 0.0 for joints in swapped) > most:
        raise InputError(f"with the {low} low the lidar leans aside: pitch and roll servo are swapped (their ids)")
    if max(turned, leaning) < 0.2:  # share that may be on the floor, for the lidar not to look there
        return 1
    raise InputError(
        f"with the {low} low the lidar sees neither a clear floor nor none: {turned:.0%} of its beams are where the "
        "floor would be; nothing may stand there"
    )


def _on_floor(
    stand: RestMeasurement, flat: RestMeasurement, joints: RollPitch, height: float, direction: float
) -> float | None:
    """Share of the beams around ``direction`` (rad) that measure the floor of a lidar with such joints (rad).

    None if it would be hardly nearer than the range of a level lidar there.
    """
    up = beams_up(stand.body, joints, stand.angles)
    floor = np.where(up < 0.0, height / np.maximum(-up, 1e-9), np.inf)
    sector: NDArray[np.bool_] = np.abs(stand.angles - direction) <= SECTOR
    # 0.8: maximum distance of a clearly different floor, as a fraction of the range there
    # 4.0: maximum distance of a visible floor, m
    due = sector & (floor < 0.8 * flat.ranges) & (floor < 4.0)
    if due.sum() < max(10, sector.sum() / 4):  # beams in the sector
        return None
    # 0.15: maximum relative difference between a range and the floor
    return float((np.abs(stand.ranges[due] / floor[due] - 1) < 0.15).mean())


def beams_up(body: RollPitch, joints: RollPitch, angles: Array) -> Array:
    """Rise of beams in the level frame, per metre: third row of Ry(p) Rx(r) Ry(a) Rx(b) on (cos, sin, 0); (n,)."""
    ahead, left = plane_slopes(body.roll, body.pitch, joints.pitch, joints.roll)
    return np.asarray(np.cos(angles) * ahead + np.sin(angles) * left)


def _check_range(name: str, joint: JointConfig, zero: float) -> None:
    if not joint.min_position < round(zero) < joint.max_position:
        raise InputError(
            f"the {name} joint is level at position {zero:.0f}, beyond its limits of {joint.min_position} to "
            f"{joint.max_position}: put its horn on by some teeth"
        )
