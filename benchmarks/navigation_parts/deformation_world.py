"""Worlds, a kinematic truck with a lidar, and a path follower, for the benchmark of deformation."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.collision import DistanceField, Footprint, clearance_to_points
from monstertruck_planners.goals.deform_step import Window
from monstertruck_planners.pose_path import PosePath
from monstertruck_planners.route.api import RouteMap, Vehicle
from monstertruck_planners.route.config import HybridConfig
from monstertruck_planners.route.hybrid import HybridPlanner
from monstertruck_planners.route.motion import MotionPath, moved
from monstertruck_sim.world.raycast import cast_rays, clearance

RES = 0.02
SIZE = (7.0, 5.0)
BODY = Footprint(padding=0.0)
TRUCK = FourWheelSteering()
STEEREST = math.radians(25.0)
PERIOD, STEP = 0.2, 0.02
BEAMS = np.radians(np.linspace(-120.0, 120.0, 401))
LIDAR = 0.14
NO_SEGMENTS = np.empty((0, 4))

Box = tuple[float, float, float, float]


def grid(*boxes: Box):  # noqa: ANN201
    """Return the occupied cells of a walled room with boxes x0, y0, x1, y1."""
    occupied = np.zeros((round(SIZE[1] / RES), round(SIZE[0] / RES)), bool)
    occupied[[0, 1, -1, -2]] = True
    occupied[:, [0, 1, -1, -2]] = True
    for x0, y0, x1, y1 in boxes:
        occupied[round(y0 / RES) : round(y1 / RES), round(x0 / RES) : round(x1 / RES)] = True
    return occupied


@dataclass
class Scenario:
    """Mapped and true obstacles."""

    name: str
    start: tuple[float, float, float]
    goal: tuple[float, float, float]
    known: tuple[Box, ...] = ()
    hidden: Callable[[float], tuple[Box, ...]] = field(default=lambda _: ())
    person: Callable[[float], tuple[float, float]] | None = None
    planned: bool = False
    """The route is planned on the known map, otherwise it is a straight line."""

    def route(self, vehicle: Vehicle) -> PosePath:
        """The route."""
        start, goal = (np.array(p) for p in (self.start, self.goal))
        if self.planned:
            route_map = RouteMap(DistanceField(grid(*self.known), RES))
            planner = HybridPlanner(vehicle, HybridConfig(margin=0.05, effort=20_000))
            path = planner.plan(route_map, vehicle.reference_pose(start), vehicle.reference_pose(goal)).path
            assert path is not None
            return path.along()
        x = np.arange(start[0], goal[0] + 0.04, 0.08)
        x[-1] = goal[0]
        poses = np.column_stack((x, np.full(len(x), start[1]), np.zeros(len(x))))
        return PosePath(moved(poses, vehicle.reference), np.ones(len(x)))


def _leaf(t: float) -> tuple[Box, ...]:
    """Return a door leaf that slides through the gap from 4 to 8 s."""
    return ((3.4, 2.1, 3.48, 2.1 + 0.65 * min(max((t - 4.0) / 4.0, 0.0), 1.0)),)


def _walker(t: float) -> tuple[float, float]:
    """Return the place of a person who crosses the route, stops on it for some seconds, and walks on."""
    return 3.0, 1.0 + 0.2 * min(t, 8.0) + 0.2 * max(t - 13.0, 0.0) if t < 21.0 else 4.2


AHEAD = ((0.8, 2.5, 0.0), (6.0, 2.5, 0.0))
SCENARIOS = (
    Scenario("static surprise", *AHEAD, hidden=lambda _: ((3.0, 2.2, 3.5, 2.7),)),
    Scenario("moving person", *AHEAD, person=_walker),
    Scenario(
        "closing gap", *AHEAD,
        known=((3.4, 0.0, 3.48, 2.1), (3.4, 2.9, 3.48, 3.1), (3.4, 3.9, 3.48, 5.0)), hidden=_leaf,
    ),
    Scenario(
        "U-trap", *AHEAD,
        hidden=lambda _: ((3.0, 1.85, 3.9, 1.93), (3.0, 3.07, 3.9, 3.15), (3.82, 1.85, 3.9, 3.15)),
    ),
    Scenario(
        "narrow door", (0.8, 2.54, 0.0), (6.0, 2.54, 0.0),
        hidden=lambda _: ((3.4, 0.0, 3.48, 2.22), (3.4, 2.78, 3.48, 5.0)),
    ),
    Scenario(
        "reverse parking", (1.0, 2.2, 0.0), (4.0, 0.6, math.pi / 2),
        known=((0.0, 0.0, 3.6, 1.1), (4.4, 0.0, 7.0, 1.1), (0.0, 3.6, 7.0, 5.0)),
        hidden=lambda _: ((4.9, 2.1, 5.2, 2.4),), planned=True,
    ),
)  # fmt: skip


def unseen(seed: int) -> tuple[Scenario, ...]:
    """Return scenarios of the same kinds with other dimensions, drawn at random, not used for development."""
    rng = np.random.default_rng([3, seed])

    def draw(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    y, size = 2.5 + draw(-0.2, 0.2), draw(0.2, 0.7)
    box = (draw(2.4, 3.6), y - draw(0.1, 0.9) * size)
    two = (draw(2.2, 2.7), draw(4.0, 4.5), draw(0.9, 1.2))
    crossing, pace, stop, stay = draw(2.6, 3.8), draw(0.15, 0.5), 2.5 + draw(-0.3, 0.3), draw(3.0, 9.0)
    depth, half, trap = draw(0.5, 1.1), draw(0.45, 0.6), draw(2.7, 3.3)
    door, wide, wall = 2.5 + draw(-0.5, 0.5), draw(0.56, 0.72), draw(2.8, 3.6)
    slot, bay = draw(3.4, 4.2), draw(0.8, 0.95)

    def walker(t: float) -> tuple[float, float]:
        there = (4.2 - stop) / pace
        return crossing, 4.2 - pace * min(t, there) - pace * max(t - there - stay, 0.0)

    return (
        Scenario("box", *AHEAD, hidden=lambda _: ((*box, box[0] + size, box[1] + size),)),
        Scenario(
            "two boxes", *AHEAD,
            hidden=lambda _: ((two[0], 2.5 - two[2], two[0] + 0.3, 2.6), (two[1], 2.4, two[1] + 0.3, 2.5 + two[2])),
        ),
        Scenario("person from the left", *AHEAD, person=lambda t: walker(t) if t < 30.0 else (crossing, 0.8)),
        Scenario(
            "trap", *AHEAD,
            hidden=lambda _: (
                (trap, 2.5 - half - 0.08, trap + depth, 2.5 - half), (trap, 2.5 + half, trap + depth, 2.58 + half),
                (trap + depth - 0.08, 2.5 - half, trap + depth, 2.5 + half),
            ),
        ),
        Scenario(
            "door aside", *AHEAD,
            hidden=lambda _: ((wall, 0.0, wall + 0.1, door - wide / 2), (wall, door + wide / 2, wall + 0.1, 5.0)),
        ),
        Scenario(
            "parking", (1.0, 2.2, 0.0), (slot + bay / 2, 0.6, math.pi / 2),
            known=((0.0, 0.0, slot, 1.1), (slot + bay, 0.0, 7.0, 1.1), (0.0, 3.7, 7.0, 5.0)),
            hidden=lambda _: ((slot + bay + 0.2, 2.0, slot + bay + 0.5, 2.3),), planned=True,
        ),
    )  # fmt: skip


class World:
    """A scenario at an instant."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self._boxes: tuple[Box, ...] | None = None
        self.person: np.ndarray = np.empty((0, 3))
        self.held = 0.0
        self.known = DistanceField(grid(*scenario.known), RES)
        self.at(0.0, None)

    def at(self, t: float, pose) -> None:  # noqa: ANN001
        """Advance to a time; a person does not walk into the truck."""
        boxes = (*self.scenario.known, *self.scenario.hidden(t))
        if boxes != self._boxes:
            self._boxes = boxes
            self.occupied = grid(*boxes)
            self._clear = clearance(self.occupied)
            rows, columns = np.nonzero(self.occupied)
            self.points = np.column_stack((columns + 0.5, rows + 0.5)) * RES
        if self.scenario.person is not None:
            person = np.array([[*self.scenario.person(t - self.held), 0.2]])
            near = pose is not None and self._gap(pose, person) < 0.25
            if near and self._gap(pose, person) < self._gap(pose, self.person):
                self.held += STEP
            else:
                self.person = person

    @staticmethod
    def _gap(pose, person) -> float:  # noqa: ANN001
        return float(clearance_to_points(BODY, np.array([pose]), person[:, :2])[0] - 0.2)

    def clearance(self, pose) -> float:  # noqa: ANN001
        """Return the distance between the truck and the nearest obstacle, m; 0 or less: contact."""
        near = self.points[np.hypot(*(self.points - np.array(pose[:2])).T) < 1.0]
        gap = float(clearance_to_points(BODY, np.array([pose]), near)[0]) - 0.5 * RES
        return min(gap, self._gap(pose, self.person)) if len(self.person) else gap

    def scan(self, pose, window: Window) -> None:  # noqa: ANN001
        """Add the lidar's view from a pose to the window."""
        x, y, yaw = pose
        x, y = x + LIDAR * math.cos(yaw), y + LIDAR * math.sin(yaw)
        angles = yaw + BEAMS
        count = len(angles)
        ranges = cast_rays(
            self._clear, RES, 0.0, 0.0, np.full(count, x), np.full(count, y), angles, 4.09, self.person, NO_SEGMENTS
        )
        hit = np.isfinite(ranges)
        ranges = np.where(hit, ranges + 0.005, 4.09)
        ends = np.column_stack((x + ranges * np.cos(angles), y + ranges * np.sin(angles)))
        window.add_scan((x, y), (pose[0], pose[1]), ends, hit)


@dataclass
class Truck:
    """Kinematic truck with limited rates: 1 rad/s of steering, 0.5 m/s2."""

    pose: tuple[float, float, float]
    speed: float = 0.0
    front: float = 0.0
    rear: float = 0.0

    def step(self, speed: float, front: float, rear: float) -> None:
        """Execute a request for one step."""
        self.front += min(max(front - self.front, -STEP), STEP)
        self.rear += min(max(rear - self.rear, -STEP), STEP)
        self.speed += min(max(speed - self.speed, -0.5 * STEP), 0.5 * STEP)
        twist = TRUCK.body_twist(self.speed, self.front, self.rear)
        self.pose = TRUCK.integrate(self.pose, *twist, STEP)


class Follower:
    """Follows a path: feed-forward of curvature and sideslip, and feedback of distance and heading."""

    def __init__(self, path: MotionPath, vehicle: Vehicle) -> None:
        self.front_only = vehicle.steering == "front"
        self.samples = path.sample(0.01)
        self.reference = path.reference
        direction = self.samples.direction
        self.cuts = [*np.flatnonzero(np.diff(direction)).tolist(), len(direction) - 1]
        self.begin, self.at = 0, 0

    def command(self, truck: Truck) -> tuple[float, float, float]:
        """Speed (m/s, negative backward), front and rear axle angle."""
        s = self.samples
        while self.cuts and s.travelled[self.cuts[0]] - s.travelled[self.at] < 0.012 and len(self.cuts) > 1:
            self.begin = self.at = self.cuts.pop(0) + 1
        end = self.cuts[0]
        x, y, yaw = moved(np.array(truck.pose), self.reference)
        reach = slice(self.at, min(self.at + 40, end) + 1)
        away = np.hypot(s.poses[reach, 0] - x, s.poses[reach, 1] - y)
        self.at += int(np.argmin(away))
        i = min(self.at + 1, end)
        d, px, py, pyaw = float(s.direction[i]), *s.poses[self.at]
        turn, slip = float(s.curvature[i]), float(s.sideslip[i])
        course = pyaw + slip
        aside = math.cos(course) * (y - py) - math.sin(course) * (x - px)
        turned = math.remainder(yaw - pyaw, math.tau)
        if self.front_only:
            turn -= 9.0 * aside + 6.0 * d * turned
            front, rear = math.atan(TRUCK.wheelbase * turn), 0.0
            front = min(max(front, -STEEREST), STEEREST)
        else:
            if abs(slip) > 0.05:
                slip, turn = slip - 2.0 * d * aside, turn - 3.0 * d * turned
            else:
                turn -= 9.0 * aside + 6.0 * d * turned
            front, rear = TRUCK.limit_keeping_curvature(*TRUCK.steer_for(turn, slip), STEEREST)
        left = float(s.travelled[end] - s.travelled[self.at])
        top = 0.2 if d > 0 else 0.15
        speed = min(top, math.sqrt(2 * 0.3 * max(left - 0.005, 0.0)))
        off = max(abs(front - truck.front), abs(rear - truck.rear))
        return d * max(speed * max(1.0 - off / 0.3, 0.0), 0.02 if off < 0.3 and left > 0.005 else 0.0), front, rear
