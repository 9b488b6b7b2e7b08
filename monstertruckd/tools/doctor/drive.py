"""Drives of 20 cm there and back, to both sides where possible, which reveal sensors, motor and steering of wrong sign.

Motor and steering give distance and turn of the robot; the lidar's scans, compass and IMU each measure them
independently. A single sensor that disagrees with the motor and the others has the wrong sign; if all disagree, the
sign of the motor or the steering is wrong.
"""

import math
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from monstertruck_estimation.slam.registration import Cloud, register
from monstertruck_kinematics.chassis import TruckChassis
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import between, compose
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError, RequestRefusedError, TruckError
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruckd.config.truck import TruckConfig
from monstertruckd.tools.calibrate.lidar import LEAST_OVERLAP, resting_scan
from monstertruckd.tools.calibrate.steps import MoveRecord, MoveStep
from monstertruckd.tools.doctor.context import Finding, fail, fine, warn

SPEED: Final = 0.06
CLEAR: Final = 0.3
"""Share of the turn that a sensor must have seen."""
SIGN_ONLY: Final = "calibrate drive --sign-only"
ROUGH: Final = "calibrate steering --rough"

Drives = Callable[[MoveStep], Awaitable[MoveRecord]]


@dataclass(frozen=True, slots=True)
class Movement:
    """One move, as measured by each source."""

    distance: float
    """Distance by the motor, m, negative backwards"""
    turn: float
    """Turn by motor and steering, rad, left positive"""
    seen: Mapping[str, float]
    """Turn by each sensor (rad)"""
    distance_seen: float | None
    """Distance by the lidar (m); None: its scans do not match, or do not determine it, as in a corridor"""


async def signs(drives: Drives, config: TruckConfig, command: Callable[..., str]) -> list[Finding]:
    """Drive, and compare the signs.

    Args:
        drives: moves the robot as an operator; raises if the gate refuses.
        config: configuration of the daemon.
        command: returns a command line of this installation.
    """
    chassis = config.chassis()
    if not isinstance(chassis, TruckChassis):
        text = f"body {config.body.kind}: the test drive needs two steered axles"
        return [warn("signs", Reason.NOT_SUPPORTED, text)]
    present = config.devices.present()
    also = tuple(topic for role, topic in (("lidar", topics.SCAN), ("imu", topics.IMU)) if role in present)
    lidar = None if config.devices.lidar is None else np.array(config.devices.lidar.mount.planar)
    moves: list[Movement] = []
    # angle of both axles, in opposite directions, rad: so small that the gate tolerates a turn to the wrong side
    angle = 0.045
    for side, steered in (("left", angle), ("right", -angle)):
        for direction, speed in (("ahead", SPEED), ("back", -SPEED)):
            step = MoveStep(f"20 cm {direction}, wheels {side}", speed, steered, -steered, 0.2, also=also)  # m
            try:
                moves.append(movement(await drives(step), chassis, lidar))
            except TruckError as error:
                reason = error.refusal if isinstance(error, RequestRefusedError) else error.reason
                return [fail("signs", reason, f"{step.name}: {error}")]
    return list(judged(moves, command))


def movement(record: MoveRecord, chassis: TruckChassis, lidar: Array | None) -> Movement:
    """Return the measurements of a move.

    Args:
        record: with scans and IMU, if present.
        chassis: chassis of the robot.
        lidar: mount of the lidar (m and rad), or None.
    """
    distance, turn = by_wheels(record, chassis)
    seen: dict[str, float] = {}
    if len(record.attitude) > 1:
        seen["compass"] = record.turned()
    imu = record.of(topics.IMU)
    if len(imu) > 1:
        stamps = np.array([m.stamp for m in imu]) / SECOND
        rates = np.array([m.angular_velocity.z for m in imu])
        still = rates[np.array([m.stamp for m in imu]) < record.left]
        rates = rates - (still.mean() if still.size else 0.0)
        seen["IMU"] = float(np.sum(np.diff(stamps) * (rates[1:] + rates[:-1]) / 2))
    moved = None if lidar is None else by_lidar(record, (distance, turn), lidar)
    if moved is not None:
        seen["lidar"] = float(moved[2])
    return Movement(distance, turn, seen, None if moved is None or math.isnan(moved[0]) else float(moved[0]))


def by_wheels(record: MoveRecord, chassis: TruckChassis) -> tuple[float, float]:
    """Return distance (m) and turn (rad) by motor and steering."""
    motor, front, rear = record.steps()
    distance = turn = 0.0
    for step, servos in zip(motor.tolist(), zip(front.tolist(), rear.tolist(), strict=True), strict=True):
        axles = chassis.steering(*servos)
        along = float(chassis.drivetrain.distance(step)) / chassis.bicycle.drive_speed(1.0, *axles)
        distance += along
        turn += along * chassis.bicycle.curvature(*axles)
    return distance, turn


def by_lidar(record: MoveRecord, wheels: tuple[float, float], mount: Array) -> Array | None:
    """Return the motion of the body by the scans at rest before and after, (3,) (m and rad); None if they do not match.

    The wheels give one initial guess, reversed motions and turns the others. If the scans do not determine the motion,
    as in a corridor without a visible end, x and y are NaN.
    """
    try:
        before, after = (resting_scan(found) for found in record.at_rest(topics.SCAN))
    except InputError:
        return None
    cloud, best, moved = Cloud.of(before), LEAST_OVERLAP, None
    ahead = np.array((math.cos(mount[2]), -math.sin(mount[2]), 0.0))  # of the body, in the lidar's axes
    for along, sense in ((1, 1), (-1, -1), (1, -1), (-1, 1)):
        distance, turn = along * wheels[0], sense * wheels[1]
        body = np.array((distance * math.cos(turn / 2), distance * math.sin(turn / 2), turn))
        found = register(after, cloud, between(mount, compose(body, mount)), reach=0.15)
        found = register(after, cloud, found.pose)
        if found.overlap > best:
            best, moved = found.overlap, compose(compose(mount, found.pose), between(mount, np.zeros(3)))
            # 1e-3 * np.eye(3): information of scans that see nothing
            # 0.05: standard deviation of a motion by scans, m, above which it is not determined: 0.01 where a wall is
            # ahead, 0.4 along a corridor
            if ahead @ np.linalg.solve(found.information + 1e-3 * np.eye(3), ahead) > 0.05**2:
                moved[:2] = math.nan
    return moved


def judged(moves: list[Movement], command: Callable[..., str]) -> Iterator[Finding]:
    """Yield the findings of all moves together: turns and distances of a move back count with their signs."""
    turn = sum(abs(move.turn) for move in moves)
    if turn < 0.1:  # minimum turn of all moves together to judge a sign, rad
        text = (
            f"motor and steering turned it by {math.degrees(turn):.0f} degrees in total: too little to determine a sign"
        )
        yield warn("signs", Reason.STEERING_DEAD, text)
        return
    shares = shares_of_turn(moves)
    against = [name for name, share in shares.items() if share < -CLEAR]
    agree = [name for name, share in shares.items() if share > CLEAR]
    # 0.05: minimum distance of a move to judge a sign, m
    along = sum(
        move.distance_seen * move.distance
        for move in moves
        if move.distance_seen is not None and abs(move.distance) > 0.05
    )
    backward = along < 0.0
    if backward and "lidar" in against:
        seen = "the lidar shows backward motion while the motor counts forward: the motor's sign is wrong"
        yield fail("sign motor", Reason.BAD_CONFIG, seen, command(*SIGN_ONLY.split()))
    elif backward:
        seen = (
            "the lidar shows backward motion while the motor counts forward, but the right turn: the lidar "
            "faces backwards"
        )
        yield fail(
            "sign lidar", Reason.BAD_CONFIG, f"{seen} (its mount's yaw is near 3.14), or motor and steering are wrong"
        )
    elif along > 0.0:
        yield fine("sign motor", "the lidar shows motion in the direction that the motor counts")
    elif "lidar" in shares:
        yield fine("sign motor", "not determined: the walls look alike along the whole path; drive with a wall ahead")
    if shares and not agree and not against:
        seen = f"{', '.join(shares)} measured no turn: the direction of one axle is wrong, or a servo is loose"
        yield fail("sign steering", Reason.STEERING_DEAD, seen, command(*ROUGH.split()))
    elif agree or not against:
        yield from _turns(shares, against, [name for name in agree if not (backward and name == "lidar")])
    elif not backward:  # a motor that turns the other way turns the robot the other way, too
        seen = f"{', '.join(against)} turned opposite to the steering: the directions of the wheels are wrong"
        yield fail("sign steering", Reason.STEERING_DEAD, seen, command(*ROUGH.split()))


def shares_of_turn(moves: Sequence[Movement]) -> dict[str, float]:
    """Return each sensor's share of the turn by motor and steering: 1 for all of it, negative for the opposite sign.

    Off-centre wheels add a constant turn per metre, independent of the steering; it is removed.
    """
    found = {}
    for name in ("compass", "IMU", "lidar"):
        rows = [(move.turn, move.distance, move.seen[name]) for move in moves if name in move.seen]
        if len(rows) > 1:
            turns, distances, seen = np.array(rows).T
            found[name] = float(np.linalg.lstsq(np.column_stack((turns, distances)), seen, rcond=None)[0][0])
    return found


def _turns(shares: Mapping[str, float], against: Sequence[str], agree: Sequence[str]) -> Iterator[Finding]:
    """Yield findings about sensors that turned with motor and steering, against them, or hardly."""
    for name, share in shares.items():
        if name in against:
            seen = f"it turns opposite to the steering and the {', '.join(agree)}: it is mounted upside down"
            yield fail(f"sign {name}", Reason.BAD_CONFIG, seen)
        elif name in agree:
            yield fine(f"sign {name}", "turns like motor and steering")
        elif abs(share) <= CLEAR:
            seen = f"it measured {share:.0%} of the turn by motor and steering: it is stuck, or its scale is wrong"
            yield warn(f"sign {name}", Reason.DEVICE_FAULT, seen)
