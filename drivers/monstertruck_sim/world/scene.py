"""Surroundings shared by the robots of one world: map, ground, obstacles, people, the robots' outlines, and time.

All bodies move on one time grid of 5 ms: before a robot is integrated to an instant, everything is advanced to the last
grid point before it. The poses of other bodies are therefore at most 5 ms old: 1 mm at 0.2 m/s.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import hypot
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.map_files import FREE, OCCUPIED
from monstertruck_sim.world.built_in import BuiltIn
from monstertruck_sim.world.config import PersonConfig
from monstertruck_sim.world.obstacles import Box, Disc, Obstacle, discs_and_segments, penetration
from monstertruck_sim.world.people import STEP_S, Person
from monstertruck_sim.world.plant import Plant
from monstertruck_sim.world.raycast import cast_rays, clearance, grid_penetration
from monstertruck_sim.world.truck_plant import STEP_NS

MOVING = 0.01
"""Maximum speed of a body at rest (m/s)."""
_WALK_NS = round(STEP_S * 1e9)


@dataclass(frozen=True, slots=True)
class Contact:
    """One body ran into another."""

    time_ns: int
    mover: str
    """The body that moved into the other: name of a robot, or ``person N``."""
    other: str
    speed: float
    """Speed of the mover (m/s)."""
    other_speed: float

    def __str__(self) -> str:
        return f"contact: {self.mover} at {self.speed:.2f} m/s with {self.other} at {self.other_speed:.2f} m/s"


class Neighbour(Protocol):
    """Interface of a robot to other bodies."""

    name: str

    @property
    def plant(self) -> Plant:
        """The robot's physics."""

    @property
    def outline(self) -> Box:
        """Latest footprint."""

    @property
    def pace(self) -> float:
        """Speed of the body's fastest point (m/s)."""

    def integrate(self, time_ns: int) -> None:
        """Advance to a time; the first call sets the start."""

    def outlines(self, times_ns: NDArray[np.int64]) -> list[Box]:
        """Footprints of the moving bodies at sampled times in the last half second."""


class Surroundings:
    """The surroundings of one robot, or of several.

    Args:
        place: map and ground.
        people: people who walk through the world.
        seed: seed for the people.
        starts: start poses of all robots, around which hills are level.

    Raises:
        InputError: a person's path is not free.
    """

    def __init__(self, place: BuiltIn, people: Sequence[PersonConfig], seed: int, starts: Sequence[Pose2]) -> None:
        self.place, self.map, self.starts = place, place.map, tuple(starts)
        self.solid = place.map.cells != FREE
        """Cells in which robots and people may not start."""
        self._occupied = place.map.cells == OCCUPIED
        self._clear = clearance(self._occupied)
        self._obstacles: tuple[Obstacle, ...] = ()
        self._fixed = discs_and_segments(())
        self.bodies: list[Neighbour] = []
        (x0, y0), (rows, columns) = self.map.origin, self.map.cells.shape
        bounds = x0, x0 + columns * self.map.resolution, y0, y0 + rows * self.map.resolution
        self.people: list[Person] = []
        for i, config in enumerate(people):
            try:
                self.people.append(Person(f"person {i + 1}", config, seed, i, self._walkable, bounds))
            except ValueError as error:
                raise InputError(f"sim.world.people.{i}: {error}") from error
        self._start_ns: int | None = None
        self._elapsed = 0
        self.contacts: list[Contact] = []
        """All contacts so far."""
        self.on_contact: Callable[[Contact], None] = lambda _: None
        self._touching: set[tuple[str, str]] = set()
        self.cast(np.zeros(1), np.zeros(1), np.zeros(1), 0.0)  # compiles outside of any deadline

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """Obstacles that are not on the map and do not move by themselves."""
        return self._obstacles

    def set_obstacles(self, obstacles: tuple[Obstacle, ...]) -> None:
        """Replace the obstacles."""
        self._obstacles = obstacles
        self._fixed = discs_and_segments(obstacles)

    def add_body(self, body: Neighbour) -> None:
        """Add a robot.

        Raises:
            InputError: the robot's name is taken, or it overlaps another robot or a person.
        """
        outline = body.outline
        for other in self.bodies:
            if other.name == body.name:
                raise InputError(f"robot {body.name}: two robots of this name in one world")
            if penetration(outline, other.outline) > 0:
                raise InputError(f"start: the robots {other.name} and {body.name} overlap")
        for person in self.people:
            if penetration(outline, person.disc) > 0:
                raise InputError(f"start: the robot {body.name} and {person.name} overlap")
        self.bodies.append(body)

    def robots_beside(self, own: Plant) -> list[Plant]:
        """Return the physics of the other robots."""
        return [body.plant for body in self.bodies if body.plant is not own]

    def advance(self, time_ns: int) -> None:
        """Advance all moving bodies to the last grid point before a time."""
        if len(self.bodies) < 2 and not self.people:
            return
        if self._start_ns is None:
            self._start_ns = time_ns
            for body in self.bodies:
                body.integrate(time_ns)
        until = time_ns - self._start_ns
        while self._elapsed + STEP_NS <= until:
            self._elapsed += STEP_NS
            for body in self.bodies:
                body.integrate(self._start_ns + self._elapsed)
            if self._elapsed % _WALK_NS == 0:
                for person in self.people:
                    self._walk(person)
                self._part()

    # Contact

    def fixed_overlap(self, box: Box) -> float:
        """Return the depth of a footprint's overlap with the map and the obstacles (m); 0 without contact."""
        return self.overlap(self._occupied, box) + sum(penetration(box, obstacle) for obstacle in self._obstacles)

    def overlap(self, solid: NDArray[np.bool_], box: Box) -> float:
        """Return the depth of a footprint's overlap with cells (m)."""
        x0, y0 = self.map.origin
        depth: float = grid_penetration(
            solid, self.map.resolution, box.x - x0, box.y - y0, box.yaw, box.length, box.width
        )
        return depth

    def moving_overlap(self, box: Box, name: str) -> float:
        """Return how deep the footprint of the robot ``name`` overlaps other robots and people (m)."""
        return sum(depth for _, _, depth in self._met(box, name))

    def report(self, box: Box, name: str, speed: float) -> None:
        """Report contacts of the robot ``name`` with the bodies that block its move to ``box``."""
        for other, pace, _ in self._met(box, name):
            self._contact(name, other, speed, pace)

    def _met(self, box: Box, name: str) -> list[tuple[str, float, float]]:
        """Return the name, speed and penetration depth of every body that a footprint overlaps."""
        found = []
        size = hypot(box.length, box.width) / 2
        for body in self.bodies:
            if body.name != name:
                other = body.outline
                reach = size + hypot(other.length, other.width) / 2
                if hypot(other.x - box.x, other.y - box.y) < reach and (depth := penetration(box, other)) > 0:
                    found.append((body.name, body.pace, depth))
        for person in self.people:
            near = hypot(person.x - box.x, person.y - box.y) < size + person.radius
            if near and (depth := penetration(box, person.disc)) > 0:
                found.append((person.name, person.speed, depth))
        return found

    def _contact(self, mover: str, other: str, speed: float, other_speed: float) -> None:
        pair = (min(mover, other), max(mover, other))
        if pair in self._touching:
            return
        self._touching.add(pair)
        at = (self._start_ns or 0) + self._elapsed
        contact = Contact(at, mover, other, speed, other_speed)
        self.contacts.append(contact)
        self.on_contact(contact)

    def _part(self) -> None:
        """Forget pairs of bodies that have separated, so that their next contact is reported again."""
        for pair in sorted(self._touching):
            # 0.08: minimum distance of bodies that have parted, m: more than a stride
            first, second = (self._shape(name, 2 * 0.08) for name in pair)
            box, other = (first, second) if isinstance(first, Box) else (second, first)
            if isinstance(box, Box) and penetration(box, other) == 0.0:
                self._touching.discard(pair)

    def _shape(self, name: str, grown: float) -> Obstacle:
        for body in self.bodies:
            if body.name == name:
                box = body.outline
                return Box(box.x, box.y, box.length + grown, box.width + grown, box.yaw)
        person = next(person for person in self.people if person.name == name)
        return person.disc

    # People

    def _walk(self, person: Person) -> None:
        others = [(other.x, other.y, other.radius) for other in self.people if other is not person]
        others += [(box.x, box.y, hypot(box.length, box.width) / 2) for box in (body.outline for body in self.bodies)]

        def touched(disc: Disc) -> bool:
            for other in self.people:
                apart = hypot(other.x - disc.x, other.y - disc.y)
                if other is not person and apart < other.radius + disc.radius:
                    return True
            met = [body for body in self.bodies if penetration(body.outline, disc) > 0]
            for body in met:
                self._contact(person.name, body.name, person.pace, body.pace)
            return bool(met)

        person.step(self._elapsed, others, touched)

    def _walkable(self, x: float, y: float, radius: float) -> bool:
        return self.overlap(self.solid, Box(x, y, 2 * radius, 2 * radius)) == 0.0

    # Sight

    def people_at(self, time_ns: int) -> list[tuple[float, float, float]]:
        """Return x, y and radius (m) of every person at a time within the last half second."""
        elapsed = np.array([float(time_ns - (self._start_ns or 0))])
        found = [(person.places(elapsed)[:, 0].tolist(), person.radius) for person in self.people]
        return [(x, y, radius) for (x, y), radius in found]

    def cast(
        self,
        xs: Array,
        ys: Array,
        angles: Array,
        reach: float,
        times_ns: NDArray[np.int64] | None = None,
        without: str = "",
    ) -> Array:
        """Return the range of each ray's first hit (m); inf without a hit within ``reach``.

        Args:
            xs: (n,) origins in the map frame (m).
            ys: (n,) as ``xs``.
            angles: (n,) directions in the map frame (rad).
            reach: maximum distance (m).
            times_ns: (n,) times of the rays, increasing: moving bodies are hit where they were at that time; None for
                the current time.
            without: name of the robot with the sensor.
        """
        others = [body for body in self.bodies if body.name != without]
        if not others and not self.people:
            return self._cast(xs, ys, angles, reach, self._fixed)
        if times_ns is None:
            now: list[Obstacle] = [*(body.outline for body in others), *(person.disc for person in self.people)]
            return self._cast(xs, ys, angles, reach, discs_and_segments((*self._obstacles, *now)))
        count = len(angles)
        rays = 64  # rays of a sweep that hit moving bodies at one time: 6 ms of the lidar's revolution
        middles = times_ns[np.minimum(np.arange(0, count, rays) + rays // 2, count - 1)]
        boxes = [body.outlines(middles) for body in others]
        elapsed = (middles - (self._start_ns or 0)).astype(float)
        walks = [(person.places(elapsed), person.radius) for person in self.people]
        ranges = np.empty(count)
        for i, first in enumerate(range(0, count, rays)):
            part = slice(first, first + rays)
            discs = [Disc(float(places[0, i]), float(places[1, i]), radius) for places, radius in walks]
            met = discs_and_segments((*self._obstacles, *(box[i] for box in boxes), *discs))
            ranges[part] = self._cast(xs[part], ys[part], angles[part], reach, met)
        return ranges

    def _cast(self, xs: Array, ys: Array, angles: Array, reach: float, met: tuple[Array, Array]) -> Array:
        ranges: Array = cast_rays(self._clear, self.map.resolution, *self.map.origin, xs, ys, angles, reach, *met)
        return ranges
