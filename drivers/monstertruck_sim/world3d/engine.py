"""The engine ``mujoco``: one robot of rigid bodies in the surroundings shared by all engines.

Walls, ground and all moving bodies are in MuJoCo's model for contact. Sensor rays are cast on the same map and heights
using the project's own kernels: MuJoCo's rays cost 0.9 ms per scan against 400 boxes and 0.3 s against a 400 x 400
height field. MuJoCo's rays are used only for blocks on the ground, which those kernels do not model.
"""

from functools import partial
from math import hypot, radians

import mujoco
import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.description import WHEELS, LidarHead, Mechanics, wheel_inertia
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.platform import frame_name, rolled
from monstertruck_kinematics.se2 import Pose2
from monstertruck_kinematics.truck import FourWheelSteering, LinkedAxles
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.map_files import OCCUPIED
from monstertruck_sim.world.config import LidarConfig, SimTruckConfig, TiltConfig, WorldConfig
from monstertruck_sim.world.mechanics import description, mechanics, platform_wheels
from monstertruck_sim.world.obstacles import Box, Disc, Obstacle
from monstertruck_sim.world.plane import Engine, PlanOutline, Space
from monstertruck_sim.world.plant import Caster
from monstertruck_sim.world.scene import Neighbour
from monstertruck_sim.world.sensors import LEVEL_BEAMS, Beams, UnevenGround, over, turned
from monstertruck_sim.world3d.ground import blocks, ground_heights, scenery
from monstertruck_sim.world3d.model import (
    PARKED,
    SPARE,
    TALL,
    UNTOUCHED,
    UPRIGHT,
    DriveLine,
    Group,
    StaticScene,
    load,
    rectangles,
)
from monstertruck_sim.world3d.plant import RigidPlant, Steering

_Shown = tuple[Obstacle, bool] | None
"""Content of a spare body, and whether pictures show it (people have their own shapes); None: unused."""


class LevelGround:
    """Ground at height 0 everywhere."""

    def height(self, x: Array, y: Array) -> Array:
        """Return 0, in the shape of the points."""
        return np.zeros(np.broadcast(x, y).shape)

    def cast(self, xs: Array, ys: Array, zs: Array, headings: Array, rises: Array, reach: float) -> Array:
        """See ``UnevenGround``."""
        with np.errstate(divide="ignore"):
            met = np.where(rises < 0.0, zs / -rises, np.inf)
        return np.where(met <= reach, met, np.inf)


class RigidSpace(Space):
    """``Space`` of rigid bodies; spare bodies represent obstacles, people and other robots.

    Args:
        footprint: the robot's footprint in its surroundings.
        plant: the robot in its MuJoCo model.
        ground: the ground.
        name: robot name.
    """

    def __init__(self, footprint: PlanOutline, plant: RigidPlant, ground: UnevenGround, name: str) -> None:
        super().__init__(footprint)
        self._plant, self._ground, self._name = plant, ground, name
        self._shown: dict[str, list[_Shown]] = {"disc": [None] * SPARE, "box": [None] * SPARE}
        self._known: tuple[Obstacle, ...] = ()
        for kind, spare in self._shown.items():
            for i in range(len(spare)):
                self._show(f"{kind}_{i}", None)

    def add(self, obstacle: Obstacle) -> None:
        """Add an obstacle.

        Raises:
            InputError: no spare body of the obstacle's kind is left.
        """
        kind, people = type(obstacle), [person.disc for person in self._scene.people]
        robots = [body.outline for body in self._others()]
        if sum(isinstance(other, kind) for other in (*self.obstacles, *robots, *people)) >= SPARE:
            raise InputError(
                f"obstacle: the world already contains the maximum of {SPARE} of kind {kind.__name__.lower()}"
            )
        super().add(obstacle)

    def set_tilt(self, tilt: TiltConfig) -> None:
        """Put the robot onto blocks, or back onto the ground.

        Raises:
            InputError: the tilt oscillates, or the robot cannot stand at this tilt.
        """
        if tilt.kind == "sinusoid":
            raise InputError("tilt sinusoid: not supported with engine mujoco; expected ground or steady")
        pitch, roll = (tilt.pitch_deg, tilt.roll_deg) if tilt.kind == "steady" else (0.0, 0.0)
        self._plant.stand(radians(pitch), radians(roll))

    def follow(self) -> None:
        """Move the bodies to the current poses of the objects they represent."""
        robots: list[tuple[Obstacle, bool]] = [
            (body.outline, not isinstance(body.plant, RigidPlant)) for body in self._others()
        ]
        people = [person.disc for person in self._scene.people]
        if not robots and not people and self._known is self.obstacles:
            return
        self._known = self.obstacles
        # Robots of rigid bodies and people are drawn with their own shapes.
        there = [(shape, True) for shape in self._known] + [(disc, False) for disc in people] + robots
        for kind, cls in (("disc", Disc), ("box", Box)):
            shown = self._shown[kind]
            wanted: list[_Shown] = [each for each in there if isinstance(each[0], cls)]
            wanted += [None] * (SPARE - len(wanted))
            for i, each in enumerate(wanted[:SPARE]):
                if each != shown[i]:
                    self._show(f"{kind}_{i}", each)
                    shown[i] = each

    def _others(self) -> list[Neighbour]:
        return [body for body in self._scene.bodies if body.name != self._name]

    def _show(self, name: str, shown: _Shown) -> None:
        """Move a spare body to an object's pose; unused bodies cost neither integration nor rendering."""
        model, data = self._plant.model, self._plant.data
        body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
        mocap, geom = model.body_mocapid[body], model.body_geomadr[body]
        kind, affinity = UNTOUCHED if shown is None else UPRIGHT
        model.geom_contype[geom] = model.body_contype[body] = kind
        model.geom_conaffinity[geom] = model.body_conaffinity[body] = affinity
        model.geom_rgba[geom, 3] = shown is not None and shown[1]
        if shown is None:
            data.mocap_pos[mocap] = 0.0, 0.0, PARKED
            return
        shape = shown[0]
        foot = float(self._ground.height(np.array(shape.x), np.array(shape.y)))
        data.mocap_pos[mocap] = shape.x, shape.y, foot + TALL / 2
        if isinstance(shape, Disc):
            size, half = (shape.radius, TALL / 2, 0.0), (shape.radius, shape.radius, TALL / 2)
        else:
            size = half = (shape.length / 2, shape.width / 2, TALL / 2)
            data.mocap_quat[mocap] = np.cos(shape.yaw / 2), 0.0, 0.0, np.sin(shape.yaw / 2)
        model.geom_size[geom] = size
        model.geom_rbound[geom] = hypot(*half)
        model.geom_aabb[geom, 3:] = half
        model.bvh_aabb[model.body_bvhadr[body], 3:] = half


class RigidSweep:
    """Casts beams against ground, walls and blocks; the mount moves with the body.

    Args:
        plant: the robot in its MuJoCo model.
        cast: horizontal ranges to walls, obstacles, people and robots.
        ground: the ground.
        config: lidar configuration.
    """

    def __init__(self, plant: RigidPlant, cast: Caster, ground: UnevenGround, config: LidarConfig) -> None:
        self._plant, self._cast, self._ground, self._config = plant, cast, ground, config
        self._blocks = has_blocks(plant)

    def __call__(self, poses: Array, beams: Beams | None, times_ns: NDArray[np.int64], reach: float) -> Array:
        """See ``Sweep``."""
        x, y, yaw, pitch, roll, z = poses
        config = self._config
        beams = turned(LEVEL_BEAMS if beams is None else beams, pitch, roll)
        still = np.zeros(len(x))
        ahead, aside, up = turned((still + config.x, still + config.y, still + config.height), pitch, roll)
        c, s = np.cos(yaw), np.sin(yaw)
        origins = x + c * ahead - s * aside, y + s * ahead + c * aside, z + up
        ranges = over(self._cast, self._ground, config, origins, yaw, beams, times_ns, reach)
        return np.minimum(ranges, self._to_blocks(origins, yaw, beams, reach)) if self._blocks else ranges

    def _to_blocks(self, origins: Beams, yaw: Array, beams: Beams, reach: float) -> Array:
        c, s = np.cos(yaw), np.sin(yaw)
        ways = np.stack([c * beams[0] - s * beams[1], s * beams[0] + c * beams[1], beams[2]], axis=1)
        return to_blocks(self._plant, np.stack(origins, axis=1), ways, reach + 0.1)


class RigidEchoes:
    """``Solids``: blocks on the ground, for the rays from sonars that tilt with the body.

    Args:
        plant: the robot in its MuJoCo model.
        height: height of the sonars above the ground (m).
    """

    def __init__(self, plant: RigidPlant, height: float) -> None:
        self._plant, self._height = plant, height
        self._blocks = has_blocks(plant)

    def __call__(self, yaw: float, pitch: float, roll: float, z: float) -> Caster | None:
        """See ``Solids``."""
        if not self._blocks:
            return None
        height = z + self._height

        def along(
            xs: Array, ys: Array, angles: Array, reach: float, times_ns: NDArray[np.int64] | None = None, /
        ) -> Array:
            flat = np.cos(angles - yaw), np.sin(angles - yaw), np.zeros(len(angles))
            ahead, aside, up = turned(flat, np.array(pitch), np.array(roll))
            c, s = np.cos(yaw), np.sin(yaw)
            ways = np.stack([c * ahead - s * aside, s * ahead + c * aside, up], axis=1)
            places = np.stack([xs, ys, np.full(len(angles), height)], axis=1)
            ranges = to_blocks(self._plant, places, ways, reach)
            return np.where(ranges <= reach, ranges, np.inf)

        return along


def has_blocks(plant: RigidPlant) -> bool:
    """Whether there are blocks on the ground, which the kernels for walls and heights do not model."""
    return bool((plant.model.geom_group == Group.BLOCKS).any())


def to_blocks(plant: RigidPlant, places: Array, ways: Array, reach: float) -> Array:
    """Return the beams' ranges (m), (n,), to blocks on the ground, using MuJoCo's rays; inf beyond ``reach``.

    Args:
        plant: the robot in its MuJoCo model.
        places: beam origins, (n, 3) (m); neighbours in the array are neighbours in space.
        ways: directions as unit vectors, (n, 3).
        reach: maximum distance (m).
    """
    count = len(ways)
    group = np.array([i == Group.BLOCKS for i in range(mujoco.mjNGROUP)], dtype=np.uint8)
    geoms, met = np.empty(count, dtype=np.int32), np.empty(count)
    ranges = np.full(count, np.inf)
    rays = 64  # beams cast from one origin at blocks; each range is corrected for its own origin
    for first in range(0, count, rays):
        part = slice(first, min(first + rays, count))
        size = part.stop - part.start
        middle = places[first + size // 2]
        mujoco.mj_multiRay(
            plant.model, plant.data, middle, ways[part].ravel(), group, True, -1,
            geoms[part], met[part], None, size, reach,
        )  # fmt: skip
        own = met[part] + ((middle - places[part]) * ways[part]).sum(axis=1)
        ranges[part] = np.where(geoms[part] >= 0, own, np.inf)
    return ranges


def drive_line(truck: SimTruckConfig, parts: Mechanics) -> DriveLine:
    """Return a body's drive line.

    A truck has one motor for four wheels: open differentials in both axles and a rigid transfer case between them. A
    car drives its rear wheels through a differential, a skid-steer robot drives the coupled wheels on each side or
    every wheel separately, and a platform drives every wheel separately.

    The wind-up is stiff enough for the wheels to follow critically damped with the mean delay ``motor.drivetrain_lag``.
    """
    front, rear = (tuple(f"{axle}_{side}_spin" for side in ("left", "right")) for axle in ("front", "rear"))
    shafts: tuple[tuple[str, ...], ...] = ((*front, *rear),)
    locked: tuple[tuple[tuple[str, ...], tuple[str, ...]], ...] = ((front, rear),)
    wheels = platform_wheels(truck)
    if wheels:
        shafts, locked = tuple((f"{frame_name(wheel)}_spin",) for wheel in wheels), ()
    elif truck.body.kind == "ackermann":
        shafts, locked = (rear,), ()
    elif truck.body.kind == "skid_steer":
        left, right = zip(front, rear, strict=True)
        sides = (left, right) if getattr(truck.body, "motors", "sides") == "sides" else ()
        shafts = sides or tuple((joint,) for joint in (*front, *rear))
        locked = tuple(((a,), (b,)) for a, b in sides)
    radius = truck.wheel_radius
    inertia = (
        parts.mass * radius**2 + len(wheels or WHEELS) * wheel_inertia(parts.wheel_mass, radius, parts.wheel_width)[1]
    )
    natural, share = 2.0 / truck.motor.drivetrain_lag, inertia / len(shafts)
    turns = {f"{frame_name(wheel)}_spin": rolled(wheel) for wheel in wheels}
    clutch = truck.motor.clutch_force * radius
    return DriveLine(shafts, locked, share * natural**2, 2.0 * share * natural, clutch, turns)


def wheel_steering(truck: SimTruckConfig) -> Steering:
    """Return the conversion of servo angles to wheel angles: the truck's fitted linkage or a car's ideal one."""
    chassis = truck.chassis()
    linkage = chassis.linkage
    if truck.body.kind == "truck" and isinstance(linkage, LinkedAxles):
        return lambda servos: linkage.wheel_angles(*servos)
    if truck.body.kind == "ackermann":
        size = FourWheelSteering(truck.wheelbase, truck.track)
        return lambda servos: size.wheel_angles(chassis.steering(*servos)[0], 0.0)
    return lambda _: ()


def rigid(config: WorldConfig, footprint: PlanOutline, start: Pose2, *, lidar: bool) -> Engine:
    """Create a rigid-body robot, with or without a lidar on its joints.

    Raises:
        InputError: a file of the world is missing or invalid, there are too many people, or the robot cannot stand at
            its start pose.
    """
    scene = footprint.scene
    if len(scene.people) > SPARE:
        raise InputError(f"sim.world.people: {len(scene.people)}: expected at most {SPARE} with engine mujoco")
    place, truck = scene.place, config.truck
    resolution, (x0, y0) = place.map.resolution, place.map.origin
    rows, columns = place.map.cells.shape
    bounds = x0, x0 + columns * resolution, y0, y0 + rows * resolution
    heights = ground_heights(config, place.profile, bounds, scene.starts)
    ground: UnevenGround = heights if heights is not None else LevelGround()
    parts = mechanics(truck, config.mechanics)
    head = LidarHead((config.lidar.x, config.lidar.y, config.lidar.height)) if lidar else None
    robot = description(truck, parts, head=head)
    drive = drive_line(truck, parts)
    longest = 80 if heights is None else round(0.25 / resolution)
    walls = rectangles(place.map.cells == OCCUPIED, resolution, place.map.origin, longest)
    scene_files = scenery(config.mjcf) if config.mjcf is not None else ((), ())
    static_scene = StaticScene(
        walls, config.lidar.wall_height, heights, blocks(config.ground, heights), scene_files, config.tags, config.roof
    )
    model = load(robot, drive, parts.friction, static_scene)
    plant = RigidPlant(
        truck, config.battery, start, model, drive,
        wheel_steering(truck),
        lambda x, y: float(ground.height(np.array(x), np.array(y))),
        parts,
    )  # fmt: skip
    space = RigidSpace(footprint, plant, ground, footprint.name)
    plant.before_steps = space.follow
    if config.tilt.kind == "steady":
        space.set_tilt(config.tilt)
    return Engine(plant, space, partial(RigidSweep, plant, space.cast, ground), RigidEchoes(plant, config.sonar.height))
