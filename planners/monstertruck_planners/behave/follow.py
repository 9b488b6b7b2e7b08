"""Leader and follower: a robot drives along the path of another one, at a distance.

The leader is not involved: the follower receives the poses that the leader publishes, keeps its trail, and steers
towards a point on the trail (pure pursuit, Coulter 1992) at the leader's speed plus a share of the gap's error. A
leader is trusted as long as its poses arrive, by the follower's own clock.
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
    """Whom to follow, and how."""

    kind: Literal["follow"] = "follow"
    leader: str
    """One of the configuration's section `peers`"""
    distance: Metres = 1.0
    """Distance behind the leader along its path, from middle to middle, m"""
    speed: Annotated[float, Field(gt=0, le=5)] = 0.2
    """Greatest speed, m/s"""
    ahead: Metres = 0.4
    """Distance of the point on the trail that it steers to, m"""
    silence: Annotated[float, Field(gt=0, le=5)] = 0.5
    """Seconds without a pose of the leader after which it stops"""
    lost: Metres = 5.0
    """Distance from the leader at which it gives up, m"""


class Point(NamedTuple):
    """Of the trail, m, in map."""

    x: float
    y: float


@dataclass(frozen=True, slots=True)
class LeaderTrail:
    """State of a follower: where the leader was, from the point that is passed next."""

    points: tuple[Point, ...] = ()


class LeaderFollower:
    """Follows another robot.

    Args:
        config: settings.
        body: the robot's.

    Raises:
        KinematicsError: the body cannot drive curves.
    """

    reads: ClassVar[tuple[Topic[Any], ...]] = (POSE, PEERS)

    def __init__(self, config: FollowConfig, body: BehaviourBody) -> None:
        self._config, self._chassis = config, body.chassis
        self._chassis.possible((1.0, 0.0, 0.1))

    @classmethod
    def fit(cls, config: FollowConfig, body: BehaviourBody) -> Self:
        """The behaviour for a body. Raises as the class does."""
        return cls(config, body)

    def begin(self) -> LeaderTrail:
        """Nothing is known of the leader's path."""
        return LeaderTrail()

    def step(self, inputs: Inputs, state: LeaderTrail, t: float) -> BehaviourStep:
        """One step."""
        config, me, peers = self._config, inputs.of(POSE).pose, inputs.of(PEERS)
        leader = next((peer for peer in peers.peers if peer.robot == config.leader), None)
        if leader is None:
            return BehaviourStep(None, state, "listen", Reason.INPUT_STALE, f"{config.leader} was not heard yet")
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
        pace = along(leader, me) + 0.8 * (gap - config.distance)  # speed per error of the gap, 1/s
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
    """The trail with the leader's newest place at its end, and without what the follower has passed."""
    points, at = trail.points, Point(leader.x, leader.y)
    # 0.5: a leader that moves further than this from one step to the next was put down elsewhere, m
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
    """Length of the path through points, m."""
    return sum(math.dist(a, b) for a, b in itertools.pairwise(points))


def along(leader: Peer, me: Pose2D) -> float:
    """Speed with which the leader drives away from the follower, m/s; one that comes nearer has none."""
    vx, vy = to_world(leader.pose.yaw, leader.twist.vx, leader.twist.vy)
    away = vx * (leader.pose.x - me.x) + vy * (leader.pose.y - me.y)
    return math.hypot(vx, vy) if away > 0.0 else 0.0


def curvature(me: Pose2D, points: tuple[Point, ...], ahead: float) -> float:
    """Of the arc to the point of the trail at a distance, 1/m: 2 y / d^2; at most that of a quarter turn."""
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
