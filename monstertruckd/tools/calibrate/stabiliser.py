"""Zero and direction of the two servos below the lidar, from the height of its beam and its view of the floor.

Levelling runs as usual: it turns the joints against the tilt measured by the compass. On a level floor, the heights
of the beam at its window, on a wall ahead and on a wall to the left give the tilt of the lidar. Subtracting the tilt of
the body gives the true angle of the joints, so the servo positions give the zeros. With wheels on blocks, a joint that
turns in the correct direction keeps the lidar level. A joint that turns the wrong way doubles the tilt of the body, so
the beam meets the floor at the distance for twice the tilt. If a joint does not turn, or if the two joints are swapped,
the lidar has the tilt of the body.
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
    "a level floor, a wall 2.5 to 3.5 m ahead of the robot and another to its left, no object within 2.5 "
    "m ahead and to the right; two blocks, 4 to 6 cm high"
)
BLOCKS: Final = (math.radians(4.0), math.radians(15.0))
"""Tilt range of a body on blocks (rad)."""
FOLLOWS: Final = math.radians(2.0)
"""Maximum difference between the angle of a following joint and the tilt that it compensates, rad."""
SECTOR: Final = math.radians(20.0)
"""Half angle of the sector where a tilted lidar meets the floor."""
JOINTS: Final = ("pitch", "roll")

_LEVEL: Final = Confirm("level", "Place the robot on the level floor, wheels straight, and let go. Done?")
_NOSE: Final = Confirm("nose", "Put the rear wheels on blocks so that the nose is low, and let go. Done?")
_SIDE: Final = Confirm("side", "Put the left wheels on blocks instead so that the right side is low. Done?")


class RollPitch(NamedTuple):
    """Two angles (rad, REP 103): pitch is positive with the nose down, roll with the right side down."""

    pitch: float
    roll: float


@dataclass(frozen=True, slots=True)
class RestMeasurement:
    """Measurements while the truck was at rest."""

    body: RollPitch
    """Tilt of the body by the compass"""
    joints: RollPitch
    """Joint angles reported by the driver"""
    angles: Array
    """Angles of the beams, rad, left positive; (n,)"""
    ranges: Array
    """Median ranges, m; inf: no return; (n,)"""

    @classmethod
    def of(
        cls, scans: Sequence[LaserScan], tilts: Sequence[Attitude], joints: Sequence[StabiliserFeedback]
    ) -> "RestMeasurement":
        """Create a measurement from messages.

        Raises:
            InputError: a servo does not answer.
        """
        read = [(j.pitch, j.roll) for j in joints if j.pitch is not None and j.roll is not None]
        if len(read) < len(joints) / 2:
            raise InputError("a servo of the stabiliser does not answer: check its cable and power")
        pitch, roll = np.mean(np.array(read), axis=0).tolist()
        ranges, angles = stacked_ranges(scans, np.inf), bearings_of(scans[0])
        body = RollPitch(float(np.mean([a.pitch for a in tilts])), float(np.mean([a.roll for a in tilts])))
        return cls(body, RollPitch(pitch, roll), angles, np.median(ranges, axis=0))


@dataclass(frozen=True, slots=True)
class Heights:
    """Heights of the beam above the floor (m)."""

    centre: float
    ahead: float
    left: float


@dataclass(frozen=True, slots=True)
class StabiliserWizard:
    """Wizard that measures on a level floor, then with blocks below the rear wheels, then below the left wheels."""

    name: ClassVar[WizardName] = "stabiliser"
    doc: ClassVar[str] = (
        "zero and direction of both servos, from the height of the beam and from blocks under the wheels"
    )
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
        scans = await context.collect(Collect("scans of the floor and the walls", topics.SCAN, 10))
        tilts = await context.collect(Collect("tilt of the robot", topics.COMPASS, 20))
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
    """Compute zeros and directions, and check them.

    Args:
        flat: measurements on the level floor.
        nose: measurements with the nose low.
        side: measurements with the right side low.
        heights: heights of the beam.
        walls: distances to the wall ahead and to the wall on the left (m).
        settings: settings used by the daemon.
        tape_error: standard deviation of a height (m).

    Raises:
        InputError: heights are impossible, blocks are missing, a joint does not follow, or the scans fit neither
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
        # 0.3: standard deviation of a servo's position reading, steps: uniform over a step
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
                meaning="position at which the lidar is parallel to the body; 95 % interval from two heights "
                f"{walls[axis]:.1f} m apart and the compass's tilt",
                key=f"{STABILISER}.{name}.zero",
            ),
            Estimate(
                name=f"{name}_direction",
                value=direction,
                samples=1,
                meaning="+1: a rising position turns the joint in the positive direction; found from the floor "
                "seen by the lidar",
                key=f"{STABILISER}.{name}.direction",
            ),
        ]
    turned = [name for name, change in zip(JOINTS, changes, strict=True) if change < 0]
    again = f"{' and '.join(turned)} turned the wrong way: restart the daemon and check that it then levels the lidar"
    return Result(
        wizard="stabiliser",
        measured=f"heights of the beam; blocks tilting the body by {math.degrees(nose.body.pitch):.0f} and "
        f"{math.degrees(side.body.roll):.0f} deg",
        estimates=tuple(estimates),
        unobserved=("a skewed lidar on its mount: it looks like a wrong zero",),
        again=again if turned else None,
    )


def _turns(stand: RestMeasurement, flat: RestMeasurement, height: float, axis: int, really: RollPitch) -> int:
    """Return +1 if a joint turns as its driver reports, -1 if it turns in the opposite direction.

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
            f"the {name} joint is at {math.degrees(stand.joints[axis]):.0f} deg but "
            f"{math.degrees(-tilt):.0f} deg would level the lidar: the joint does not follow; see the "
            "stabiliser in `status`"
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
            f"with the {low} low, a tilted lidar would see the floor at almost the same distance as the "
            "objects there: use higher blocks or clear more floor"
        )
    most = 0.6  # minimum fraction of the sector's beams on the floor if the lidar is tilted towards it
    if turned > most:
        return -1
    if leaning > most:
        raise InputError(f"with the {low} low, the lidar tilts with the body: the horn of the {name} joint is loose")
    if max(seen(joints) or 0.0 for joints in swapped) > most:
        raise InputError(
            f"with the {low} low, the lidar tilts about the other axis: the ids of the pitch and roll servos "
            "are swapped"
        )
    if max(turned, leaning) < 0.2:  # maximum fraction on the floor if the lidar is not tilted towards it
        return 1
    raise InputError(
        f"with the {low} low, {turned:.0%} of the lidar's beams end where the floor would be, so it is "
        "unclear whether it sees the floor: remove all objects there"
    )


def _on_floor(
    stand: RestMeasurement, flat: RestMeasurement, joints: RollPitch, height: float, direction: float
) -> float | None:
    """Fraction of the beams around ``direction`` (rad) that hit the floor at these joint angles (rad).

    None if the floor would be at almost the same distance as the objects seen by a level lidar.
    """
    up = beams_up(stand.body, joints, stand.angles)
    floor = np.where(up < 0.0, height / np.maximum(-up, 1e-9), np.inf)
    sector: NDArray[np.bool_] = np.abs(stand.angles - direction) <= SECTOR
    # 0.8: maximum distance of a distinguishable floor, as a fraction of the measured range 4.0: maximum distance of a
    # visible floor, m
    due = sector & (floor < 0.8 * flat.ranges) & (floor < 4.0)
    if due.sum() < max(10, sector.sum() / 4):  # minimum number of beams in the sector
        return None
    # 0.15: maximum relative difference between a range and the floor
    return float((np.abs(stand.ranges[due] / floor[due] - 1) < 0.15).mean())


def beams_up(body: RollPitch, joints: RollPitch, angles: Array) -> Array:
    """Rise of each beam per metre in the level frame, shape (n,).

    It is the third row of Ry(p) Rx(r) Ry(a) Rx(b) times (cos, sin, 0).
    """
    ahead, left = plane_slopes(body.roll, body.pitch, joints.pitch, joints.roll)
    return np.asarray(np.cos(angles) * ahead + np.sin(angles) * left)


def _check_range(name: str, joint: JointConfig, zero: float) -> None:
    if not joint.min_position < round(zero) < joint.max_position:
        raise InputError(
            f"the {name} joint is level at position {zero:.0f}, outside its limits of "
            f"{joint.min_position} to {joint.max_position}: move its horn by some teeth"
        )
