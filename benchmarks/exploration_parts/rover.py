"""Light harness: the real grid, exploring step and route planner; the robot follows its route exactly.

Scans are taken every ``SPACING`` metres and after every turn of ``TURN``, as the mapper integrates them; the pose is
the true one. Decisions are made as by the exploration service: every ``DECIDE`` metres and at every end.
"""

import math
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks.exploration_parts.arena import BARE, BODY, MOUNT, Arena
from monstertruck_estimation.slam.config import GridConfig
from monstertruck_estimation.slam.grid import OccupancyGrid, outline
from monstertruck_estimation.slam.service import grid_message
from monstertruck_kinematics.se2 import Pose2, placed, points_relative
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.explore.config import AuthorConfig, ExplorerConfig
from monstertruck_planners.explore.exchange import ExploreSetup, ExploreTask, Viewpoint
from monstertruck_planners.explore.exploration import STUCK, TRAIL, Attempts
from monstertruck_planners.explore.explore_step import ExploringStep
from monstertruck_planners.goals.config import PlannerConfig
from monstertruck_planners.goals.exchange import PlanTask, Setup
from monstertruck_planners.goals.path_publisher import path_blocked
from monstertruck_planners.goals.plan_step import PlanningStep
from monstertruck_planners.route.api import Vehicle
from monstertruck_planners.route.config import HybridConfig
from monstertruck_schemas.state import Grid

REMEMBERED = 8
LEFT = 0.3

SPACING, TURN, DECIDE, AHEAD, SCANS = 0.1, 0.1, 0.4, 1.0, 3
EFFORTS = 3000, 60_000
SHARES = 0.9, 0.95, 0.99
SPEED = 0.2
"""m/s."""
LIMIT = 3000.0
"""Metres after which a run has failed."""
TRUCK = FourWheelSteering()


@dataclass
class Run:
    """Record of one exploration."""

    world: str
    kind: str
    seed: int
    reach: float
    metres: dict[float, float] = field(default_factory=dict)
    """Driven when each share of the reachable area was known."""
    covered: float = 0.0
    driven: float = 0.0
    collisions: int = 0
    goals: int = 0
    failures: int = 0
    home: float = math.inf
    """Metres from the start at the end."""
    decisions: list[float] = field(default_factory=list)
    """Seconds of processor time each."""
    updates: list[float] = field(default_factory=list)
    seconds: float = 0.0
    track: list[tuple[float, float, float, float]] = field(default_factory=list)
    """x, y, metres, share."""


class Rover:
    """One exploration.

    Args:
        arena: the world.
        config: settings of the explorer.
        seed: seed of start and noise.
        start: start pose; default: the seed's.
        steering: steering of the routes, 2ws or 4ws.
    """

    def __init__(
        self, arena: Arena, config: ExplorerConfig, seed: int, start: Pose2 | None = None, steering: Any = "4ws"
    ) -> None:
        self.arena, self.config = arena, config
        self.pose: Pose2 = arena.start(seed) if start is None else start
        self.home = self.pose
        self.rng = np.random.default_rng([11, seed])
        self.grid = OccupancyGrid(GridConfig())
        self.body = outline(BODY.length, BODY.width, 0.025)
        planner = PlannerConfig(
            steering=steering, route=HybridConfig(margin=0.04, unknown="blocked", reverse_cost=2.0, effort=EFFORTS[0])
        )
        thorough = planner.model_copy(update={"route": planner.route.model_copy(update={"effort": EFFORTS[1]})})
        self.planning = [PlanningStep(), PlanningStep()]
        self.setups = [Setup(c, TRUCK, BODY, MOUNT) for c in (planner, thorough)]
        self.fresh = [True, True]
        radius = Vehicle.truck(steering, angle=planner.angle).radius
        self.exploring = ExploringStep()
        self.setup: ExploreSetup | None = ExploreSetup(config, BODY, radius, 0.04, MOUNT)
        self.run = Run(arena.name, config.kind, seed, config.reach)
        x, y = arena.reachable(self.home)
        self.truth = np.column_stack((x, y))
        self.unseen = np.ones(len(x), np.bool_)
        self.attempts = self.unreached = Attempts(config.blacklist, config.attempts)
        self.trail: list[Pose2] = []
        self.stuck, self.stuck_at = 0, self.pose
        self.blameless = self.attempts, self.unreached
        self.hits = np.empty((0, 2))
        """Hits of the latest scan, in the map; taken at this pose:"""
        self.seen_from: Pose2 | None = None
        self.scanned: Pose2 | None = None
        self.sent: list[Grid | None] = [None, None]

    @property
    def now(self) -> float:
        """Seconds of driving."""
        return self.run.driven / SPEED

    def look(self) -> None:
        """Take a scan if the mapper would."""
        pose, before = self.pose, self.scanned
        if before is not None and math.dist(before[:2], pose[:2]) < SPACING and abs(pose[2] - before[2]) < TURN:
            return
        self.scanned = pose
        sensor, hits, passed = self.scan()
        under = placed(np.column_stack((self.body, np.zeros(len(self.body)))), pose)[:, :2]
        self.grid.add(sensor, hits, np.vstack((passed, under)))

    def scan(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the lidar's position, the ends of its beams, and the ends of beams without return."""
        sensor, self.hits, passed = self.arena.scan(self.pose, self.config.reach, self.rng)
        self.seen_from = self.pose
        return sensor, self.hits, passed

    def take_stock(self) -> None:
        """Send the changes to the explorer, and compute the known share."""
        tiles = tuple(grid_message(patch, 0, 0) for patch in self.grid.changes())
        for tile in tiles:
            one = time.process_time()
            self.exploring.step(ExploreTask(self.pose, tiles=(tile,), setup=self.setup))
            self.setup = None
            self.run.updates.append(time.process_time() - one)
        rest = self.truth[self.unseen]
        patch = self.grid.patch()
        column, row = np.floor((rest - patch.origin) / patch.resolution).astype(int).T
        rows, columns = patch.cells.shape
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        value = np.full(len(rest), -1)
        value[inside] = patch.cells[row[inside], column[inside]]
        known = np.flatnonzero(self.unseen)[value >= 0]
        self.unseen[known] = False
        self.run.covered = 1.0 - self.unseen.mean()
        for share in SHARES:
            if self.run.covered >= share:
                self.run.metres.setdefault(share, self.run.driven)
        self.run.track.append((self.pose[0], self.pose[1], self.run.driven, self.run.covered))
        self.map = grid_message(patch, 0, 0)

    def choose(self, current: Viewpoint | None, pursued: float) -> Viewpoint | None:
        """Request a decision."""
        begin = time.process_time()
        answer = self.exploring.step(
            ExploreTask(
                self.pose,
                choose=True,
                current=current,
                pursued=pursued,
                banned=self.attempts.banned(self.now),
                avoided=self.unreached.banned(self.now),
            )
        )
        self.run.decisions.append(time.process_time() - begin)
        return answer.target

    def route(self, goal: Pose2, *, clear: bool = True) -> np.ndarray | None:
        """Return the poses of a route."""
        if self.seen_from != self.pose:
            self.scan()
        for k in range(2):
            setup = self.setups[k] if self.fresh[k] else None
            grid = self.map if self.map is not self.sent[k] else None
            self.fresh[k], self.sent[k] = False, self.map
            answer = self.planning[k].step(PlanTask("route", self.pose, goal, self.hits, setup, grid, clear=clear))
            if answer.path is not None:
                return answer.path.poses
        self.why = f"{answer.reason}: {answer.text}"
        return None

    def drive(self, poses: np.ndarray, most: float) -> bool:
        """Follow a route for at most this distance (m); return False if it is blocked."""
        travelled = 0.0
        for k in range(1, len(poses)):
            ahead = poses[k : k + round(AHEAD / 0.05)]
            if self.blocked(np.vstack(([self.pose], ahead))):
                self.left = poses[k - 1 :]
                return False
            pose = tuple(map(float, poses[k]))
            step = math.dist(pose[:2], self.pose[:2])
            self.pose = pose  # type: ignore[assignment]
            travelled += step
            self.run.driven += step
            self.run.collisions += not self.arena.truth.free(BARE, poses[k : k + 1])[0]
            self.look()
            if travelled >= most:
                self.left = poses[k:]
                return True
        self.left = poses[len(poses) :]
        return True

    def blocked(self, ahead: np.ndarray) -> bool:
        """Whether ``SCANS`` consecutive scans show an obstacle on the route, as the goal service requires."""
        for _ in range(SCANS):
            if not path_blocked(BARE, ahead, points_relative(self.hits, self.pose), self.pose):
                return False
            self.scan()
        return True

    def explore(self) -> Run:
        """Explore until nothing is left, then drive home."""
        begin = time.process_time()
        self.look()
        self.take_stock()
        target: Viewpoint | None = None
        since = 0.0
        while self.run.driven < LIMIT and len(self.run.decisions) < 5000:
            chosen = self.choose(target, self.now - since)
            if chosen is None:
                attempts, unreached = self.attempts.released(self.now), self.unreached.released(self.now)
                if attempts is None and unreached is None:
                    break
                self.attempts, self.unreached, target = attempts or self.attempts, unreached or self.unreached, None
                continue
            if chosen is not target:
                target, since = chosen, self.now
                self.run.goals += 1
                poses = self.route(target.pose)
                if poses is None:
                    self.fail(target)
                    target = None
                    continue
                self.left = poses
            self.remember()
            free = self.drive(self.left, DECIDE)
            self.take_stock()
            if not free:
                poses = self.route(target.pose)
                if poses is None or not self.drive(poses, DECIDE):
                    self.fail(target)
                    target = None
                self.take_stock()
            elif not len(self.left) or len(self.left) == 1:
                self.arrived(target)
                target = None
        if self.config.home:
            self.go_home()
        self.run.seconds = time.process_time() - begin
        return self.run

    def remember(self) -> None:
        """Store the current place for the way back."""
        if not self.trail or math.dist(self.trail[-1][:2], self.pose[:2]) >= TRAIL:
            self.trail = [*self.trail, self.pose][-REMEMBERED:]

    def back(self) -> bool:
        """Drive back to the previous place, as ``exploration`` does; return whether there is one."""
        self.trail = [pose for pose in self.trail if math.dist(pose[:2], self.pose[:2]) > TRAIL]
        if not self.trail:
            return False
        self.stuck = 0
        self.attempts, self.unreached = self.blameless
        poses = self.route(self.trail.pop())
        if poses is not None:
            self.drive(poses, math.inf)
            self.take_stock()
        return True

    def fail(self, target: Viewpoint) -> None:
        """Exclude a viewpoint."""
        self.run.failures += 1
        if self.stuck > 0 and math.dist(self.stuck_at[:2], self.pose[:2]) < LEFT:
            self.stuck += 1
        else:
            self.stuck, self.stuck_at, self.blameless = 1, self.pose, (self.attempts, self.unreached)
        if self.stuck >= STUCK and self.back():
            return
        self.attempts = self.attempts.failed(target.frontier, self.now, ignore_first=True)
        self.unreached = self.unreached.failed(target.pose[:2], self.now)

    def arrived(self, target: Viewpoint) -> None:
        """Exclude a viewpoint for a while: the rest of its view was not visible."""
        self.stuck = 0
        if not isinstance(self.config, AuthorConfig):
            self.attempts = self.attempts.failed(target.frontier, self.now)

    def go_home(self) -> None:
        """Drive back to the start."""
        for _ in range(40):
            poses = self.route(self.home)
            if poses is None or self.drive(poses, math.inf):
                break
            self.take_stock()
        self.run.home = math.dist(self.pose[:2], self.home[:2])
