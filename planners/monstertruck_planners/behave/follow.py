"""Leader and follower: a robot drives along the path of another robot, at a distance.

The leader is not involved. The follower receives the poses that the leader publishes, keeps its trail, and steers
towards a point on the trail (pure pursuit, Coulter 1992). Its speed is the leader's speed plus a correction
proportional to the gap error. The follower trusts a leader while poses arrive, by the follower's clock.
"""

import itertools
import math
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Final, Literal, NamedTuple, Self

from pydantic import Field

from monstertruck_kinematics.elementary import KinematicsError
from monstertruck_kinematics.se2 import to_body, to_world
from monstertruck_planners.behave.api import BehaviourBody, BehaviourConfig, BehaviourStep, Inputs, RequestedMotion
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import Peer
from monstertruck_schemas.topics import PEERS, POSE, Topic

TRAIL_SPACING: Final = 0.05
"""Distance between the points of the trail, m."""

Metres = Annotated[float, Field(gt=0, le=20)]


class FollowConfig(BehaviourConfig):
    """Settings of following a leader."""

    kind: Literal["follow"] = "follow"
    leader: str
    """Name of a robot in the configuration's section `peers`"""
    distance: Metres = 1.0
    """Distance behind the leader along its path, centre to centre, m"""
    speed: Annotated[float, Field(gt=0, le=5)] = 0.2
    """Maximum speed, m/s"""
    ahead: Metres = 0.4
    """Look-ahead distance to the target point on the trail, m"""
    silence: Annotated[float, Field(gt=0, le=5)] = 0.5
    """Maximum time without a pose from the leader, s; the follower then stops"""
    lost: Metres = 5.0
    """Maximum distance from the leader, m; the follower then gives up"""


class Point(NamedTuple):
    """Trail point in map (m)."""

    x: float
    y: float


@dataclass(frozen=True, slots=True)
class LeaderTrail:
    """State of a follower: past leader positions, starting at the next point to pass."""

    points: tuple[Point, ...] = ()


class LeaderFollower:
    """Behaviour that follows another robot.

    Args:
        config: settings.
        body: body of the robot.

    Raises:
        KinematicsError: the body cannot drive curves.
    """

    reads: ClassVar[tuple[Topic[Any], ...]] = (POSE, PEERS)

    def __init__(self, config: FollowConfig, body: BehaviourBody) -> None:
        self._config, self._chassis = config, body.chassis
        self._chassis.possible((1.0, 0.0, 0.1))

    @classmethod
    def fit(cls, config: FollowConfig, body: BehaviourBody) -> Self:
        """Return the behaviour for a body; raises the same errors as the class."""
        return cls(config, body)

    def begin(self) -> LeaderTrail:
        """Return an empty trail."""
        return LeaderTrail()

    def step(self, inputs: Inputs, state: LeaderTrail, t: float) -> BehaviourStep:
        """Run one step."""
        config, me, peers = self._config, inputs.of(POSE).pose, inputs.of(PEERS)
        leader = next((peer for peer in peers.peers if peer.robot == config.leader), None)
        if leader is None:
            return BehaviourStep(None, state, "listen", Reason.INPUT_STALE, f"no pose of {config.leader} received yet")
        silent = (peers.stamp - leader.heard) / SECOND
        if silent > config.silence:
            text = f"{config.leader} has been silent for {silent:.2f} s"
            return BehaviourStep(None, state, "listen", Reason.INPUT_STALE, text)
        apart = math.dist((me.x, me.y), (leader.pose.x, leader.pose.y))
        if apart > config.lost:
            text = f"{config.leader} is {apart:.1f} m away: expected at most {config.lost:g} m"
            return BehaviourStep(None, state, "follow", Reason.PATH_LOST, text)
        state = extended(state, me, leader.pose)
        gap = length((Point(me.x, me.y), *state.points))
        pace = along(leader, me) + 0.8 * (gap - config.distance)  # speed per gap error, 1/s
        pace = min(max(pace, 0.0), config.speed)
        values = {"gap": gap, "apart": apart, "silent": silent}
        if gap <= config.distance and pace < 0.01 * config.speed:
            return BehaviourStep(None, state, "wait", values=values)
        turn = curvature(me, state.points, config.ahead)
        try:
            vx, vy, wz = self._chassis.possible((pace, 0.0, pace * turn))
        except KinematicsError as error:
            return BehaviourStep(None, state, "follow", Reason.IMPOSSIBLE_MOTION, str(error), values)
        return BehaviourStep(RequestedMotion(vx, wz, vy), state, "follow", values=values)


def extended(trail: LeaderTrail, me: Pose2D, leader: Pose2D) -> LeaderTrail:
    """Return the trail with the leader's latest position appended and passed points removed."""
    points, at = trail.points, Point(leader.x, leader.y)
    # 0.5: a leader that moves further than this between two steps was put down elsewhere, m
    if not points or math.dist(points[-1], at) > 0.5:
        points = (at,)  # straight towards it
    elif len(points) > 1 and math.dist(points[-2], at) < TRAIL_SPACING:
        points = (*points[:-1], at)
    else:
        points = (*points, at)
    here = Point(me.x, me.y)
    while len(points) > 1 and _passed(here, points[0], points[1]):
        points = points[1:]
    return replace(trail, points=points[-400:])  # points


def _passed(here: Point, first: Point, second: Point) -> bool:
    """Whether the follower has passed ``first`` towards ``second``."""
    dx, dy = second.x - first.x, second.y - first.y
    return (here.x - first.x) * dx + (here.y - first.y) * dy > 0.0 or math.dist(here, first) < TRAIL_SPACING


def length(points: tuple[Point, ...]) -> float:
    """Return the length of the path through points (m)."""
    return sum(math.dist(a, b) for a, b in itertools.pairwise(points))


def along(leader: Peer, me: Pose2D) -> float:
    """Return the leader's speed if it drives away from the follower, otherwise 0 (m/s)."""
    vx, vy = to_world(leader.pose.yaw, leader.twist.vx, leader.twist.vy)
    away = vx * (leader.pose.x - me.x) + vy * (leader.pose.y - me.y)
    return math.hypot(vx, vy) if away > 0.0 else 0.0


def curvature(me: Pose2D, points: tuple[Point, ...], ahead: float) -> float:
    """Return the curvature of the arc to the trail point ``ahead`` m away, 2 y / d^2 (1/m); at most 2 / ``ahead``."""
    here, left, target = Point(me.x, me.y), ahead, points[-1]
    for point in points:
        step = math.dist(here, point)
        if step >= left:
            share = left / step
            target = Point(here.x + share * (point.x - here.x), here.y + share * (point.y - here.y))
            break
        here, left = point, left - step
    dx, dy = target.x - me.x, target.y - me.y
    forward, aside = to_body(me.yaw, dx, dy)
    apart = max(math.hypot(dx, dy), TRAIL_SPACING)
    if forward < 0.0:
        return math.copysign(2.0 / ahead, aside)
    return min(max(2.0 * aside / apart**2, -2.0 / ahead), 2.0 / ahead)
