"""Every topic of a robot without devices, and the comparison of its messages with those read by ROS 2 nodes."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks import ROOT
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas import topics as t
from monstertruck_schemas.base import Message, Pose2D, Twist2D
from monstertruck_schemas.body import LensConfig
from monstertruck_schemas.event import LogLevel
from monstertruck_schemas.health import ServiceHealth, ServiceState
from monstertruck_schemas.plan import ExplorationPhase, GoalPhase
from monstertruck_schemas.points import PointKind, PointOfInterest
from monstertruck_schemas.sensor import (
    NO_ECHO,
    VALID_BEAM,
    BatteryLevel,
    CompressedImage,
    DriveMode,
    LaserScan,
    SonarEcho,
    SonarRanges,
    Vector3,
)
from monstertruck_schemas.state import TILT_STEP, Grid, Ground, Odometry, Peer, Transform, Transforms
from monstertruck_schemas.topics import Topic
from monstertruck_schemas.zones import Zone
from monstertruckd.config.load import load_truck

Values = dict[str, Any]
Rows = list[Any]

RATES: dict[Topic[Any], float] = {
    t.SCAN: 10, t.ODOMETRY: 50, t.POSE: 50, t.TRANSFORMS: 10, t.MAP: 0.5, t.MAP_TILES: 1, t.GROUND: 0.5, t.SEEN: 1,
    t.PATH: 0.5, t.BATTERY: 10, t.IMU: 50, t.COMPASS: 20, t.CAMERA: 15, t.SONAR: 10, t.STEERING: 20, t.DRIVE: 20,
    t.LOG: 2, t.POINTS: 0.5, t.ZONES: 0.5, t.HEALTH: 1, t.GOAL: 2, t.EXPLORE: 2, t.PEERS: 10,
}  # fmt: skip
"""Messages a second: those of the table of topics, or of a robot that drives. Events have no write end."""
CONFIG = load_truck(ROOT / "configs" / "points.yaml")[0]
"""Configuration of the robot."""
RATIO = CONFIG.geometry.drive_ratio
CELLS = 200
"""Length of a side of the map, cells."""


class Maker:
    """Creates messages with unique values.

    Args:
        seed: seed of the values.
    """

    def __init__(self, seed: int) -> None:
        self._random = np.random.default_rng(seed)
        self._image = self._random.bytes(20_000)
        self._scan = self._random.uniform(0.1, 5.0, 683)

    def _some(self, count: int, scale: float = 3.0) -> list[float]:
        values: list[float] = self._random.uniform(-scale, scale, count).tolist()
        return values

    def _pose(self) -> Pose2D:
        x, y, yaw = self._some(3)
        return Pose2D(x=x, y=y, yaw=yaw)

    def _vector(self) -> Vector3:
        return Vector3(**dict(zip("xyz", self._some(3), strict=True)))

    def _grid(self, size: int) -> Values:
        return {"resolution": 0.05, "width": size, "height": size, "origin": Pose2D(x=-5.0, y=-4.0, yaw=0.0)}

    def fields(self, topic: Topic[Any], now: int) -> Values:  # noqa: C901 - one case a topic
        """Return the fields of a topic's next message without its header."""
        match topic:
            case t.SCAN:
                codes = self._random.choice(np.array((VALID_BEAM, NO_ECHO, 40), np.uint8), 683, p=(0.8, 0.1, 0.1))
                ranges = np.where(codes == VALID_BEAM, np.roll(self._scan, now % 683), np.inf)
                return {"start_angle": -2.09, "end_angle": 2.09, "time_increment": 1e-4, "scan_time": 0.1,
                        "range_min": 0.02, "range_max": 5.6, "ranges": ranges, "codes": codes}  # fmt: skip
            case t.ODOMETRY | t.POSE:
                vx, vy, wz = self._some(3)
                covariances = {name: np.abs(self._some(9)) for name in ("pose_covariance", "twist_covariance")}
                twist = Twist2D(vx=vx, vy=vy, wz=wz)
                frame = "odom" if topic is t.ODOMETRY else "map"
                return {"frame": frame, "pose": self._pose(), "twist": twist, "age": 0.0, **covariances}
            case t.TRANSFORMS:
                return {"transforms": tuple(self._transforms(now))}
            case t.MAP:
                cells = self._random.integers(-1, 101, CELLS * CELLS).astype(np.int8)
                return {"frame": "map", **self._grid(CELLS), "cells": cells}
            case t.MAP_TILES | t.SEEN:
                cells = self._random.integers(-1, 101, 64 * 64).astype(np.int8)
                return {"frame": "map", **self._grid(64), "cells": cells}
            case t.GROUND:
                tilt = self._random.integers(0, 256, 64 * 64).astype(np.uint8)
                return {"frame": "map", **self._grid(64), "tilt": tilt, "roughness": tilt}
            case t.PATH:
                return {"frame": "map", "poses": np.array(self._some(300)), "directions": np.ones(100)}
            case t.BATTERY:
                known = {"voltage": 11.1 + self._some(1)[0], "charge": 0.7, "capacity_ah": 2.4, "current": -1.5}
                return {"raw_voltage": 11.0, "cells": 3, "level": BatteryLevel.NORMAL, **known}
            case t.IMU:
                return {"frame": "imu", "angular_velocity": self._vector(), "linear_acceleration": self._vector()}
            case t.COMPASS:
                roll, pitch = self._some(2, 0.5)
                heading = abs(self._some(1)[0])
                return {"heading": heading, "roll": roll, "pitch": pitch, "acceleration": self._vector()}
            case t.CAMERA:
                return {"frame": "camera", "data": now.to_bytes(8, "little") + self._image, "sequence": now % 2**31}
            case t.SONAR:
                near, _ = (1.5 + 0.4 * value for value in self._some(2))
                echoes = (("left", True, near), ("right", True, None), ("rear", False, None))
                rows = tuple(SonarEcho(name=n, answered=a, range=r, stamp=now) for n, a, r in echoes)
                return {"sonars": rows, "field_of_view": 0.5, "range_min": 0.03, "range_max": 3.0}
            case t.STEERING:
                front, rear = self._some(2, 0.3)
                return {"front": front, "rear": rear}
            case t.DRIVE:
                return {"position": self._some(1, 1e4)[0], "velocity": 0.0, "mode": DriveMode.ENABLED}
            case t.LOG:
                row = {"level": LogLevel.INFO, "name": "daemon", "text": f"line {now}"}
                return row | {"file": "daemon.py", "line": 7}
            case t.POINTS:
                x, y = self._some(2)
                point: Values = {"name": "door", "kind": next(iter(PointKind)), "x": x, "y": y, "yaw": 0.0}
                return {"points": (PointOfInterest(**point, covariance=np.zeros(9), first=now, last=now),)}
            case t.ZONES:
                corners = tuple((float(x), float(y)) for x, y in np.reshape(self._some(6), (3, 2)))
                return {"zones": (Zone(name="hall", kind="speed", corners=corners, limit=0.1),)}
            case t.HEALTH:
                service = ServiceHealth(name="lidar", state=ServiceState.READY, since=0, detail=f"since {now}")
                return {"services": (service,)}
            case t.GOAL:
                return {"frame": "map", "goal": self._pose(), "phase": GoalPhase.DRIVING}
            case t.EXPLORE:
                phase = ExplorationPhase.DRIVING
                return {"frame": "map", "target": self._pose(), "phase": phase, "frontiers": 4}
            case t.PEERS:
                still = Twist2D(vx=0.0, vy=0.0, wz=0.0)
                return {"frame": "map", "peers": (Peer(robot="ann", heard=now, pose=self._pose(), twist=still),)}
        raise ValueError(topic.name)

    def _transforms(self, now: int) -> Iterator[Transform]:
        mounts = {"lidar": (0.2, 0.0, 0.15), "camera": (0.18, 0.0, 0.2), "sonar_left": (0.1, 0.1, 0.1)}
        still = (0.0, 0.0, 0.0, 1.0)
        for child, translation in mounts.items():
            yield Transform(parent="base", child=child, stamp=now, translation=translation, rotation=still)
        x, y, yaw = self._some(3)
        turn = (0.0, 0.0, math.sin(yaw / 2.0), math.cos(yaw / 2.0))
        yield Transform(parent="map", child="odom", stamp=now, translation=(x, y, 0.0), rotation=turn)

    def message(self, topic: Topic[Any], now: int, seq: int) -> Message:
        """Return a topic's next message."""
        found: Message = topic.model(**{"stamp": now, "received": now, "seq": seq} | self.fields(topic, now))
        return found


# Values that a message of ROS 2 has, and those that its source has


def yaw_of(turn: Values) -> float:
    """Return the heading of a planar orientation, rad."""
    return math.remainder(2.0 * math.atan2(turn["z"], turn["w"]), math.tau)


def place_of(pose: Values) -> Rows:
    """Return x, y, heading."""
    return [pose["position"]["x"], pose["position"]["y"], yaw_of(pose["orientation"])]


def own_place(pose: Pose2D) -> Rows:
    """Return x, y, heading of the robot's own pose type."""
    return [pose.x, pose.y, math.remainder(pose.yaw, math.tau)]


def xyz(vector: Any) -> Rows:
    """Return the components of a vector of either side."""
    return list(vector.values()) if isinstance(vector, Mapping) else [vector.x, vector.y, vector.z]


PLANE = (0, 1, 5, 6, 7, 11, 30, 31, 35)
"""Places of x, y and yaw in a covariance of ROS 2."""


def planar(pose: Values) -> Rows:
    return [*place_of(pose["pose"]), *(pose["covariance"][k] for k in PLANE)]


def scan_source(m: LaserScan) -> Rows:
    saw = (m.codes == VALID_BEAM) | (m.codes <= NO_ECHO)
    return [m.start_angle, m.end_angle, m.range_max, *np.where(saw, m.ranges, np.nan)]


def odom(m: Values) -> Rows:
    twist = m["twist"]["twist"]
    speeds = [twist["linear"]["x"], twist["linear"]["y"], twist["angular"]["z"]]
    return [*planar(m["pose"]), *speeds, *(m["twist"]["covariance"][k] for k in PLANE)]


def pose_source(m: Odometry) -> Rows:
    return [*own_place(m.pose), *m.pose_covariance]


def odom_source(m: Odometry) -> Rows:
    return [*pose_source(m), m.twist.vx, m.twist.vy, m.twist.wz, *m.twist_covariance]


def transform(row: Values) -> Rows:
    names = [row["header"]["frame_id"], row["child_frame_id"]]
    return [*names, *xyz(row["transform"]["translation"]), *row["transform"]["rotation"].values()]


def base_source(m: Odometry) -> Rows:
    half = m.pose.yaw / 2.0
    return ["odom", "base_link", m.pose.x, m.pose.y, 0.0, 0.0, 0.0, math.sin(half), math.cos(half)]


def map_source(m: Transforms) -> Rows:
    (row,) = (row for row in m.transforms if row.child == "odom")
    return ["map", "odom", *row.translation, *row.rotation]


def whole(m: Values) -> Rows:
    info = m["info"]
    return [info["resolution"], info["width"], info["height"], *place_of(info["origin"]), *m["data"]]


def grid_head(m: Grid | Ground) -> Rows:
    return [m.resolution, m.width, m.height, *own_place(m.origin)]


def ground_source(m: Ground) -> Rows:
    degrees = (min(round(math.degrees(value * TILT_STEP)), 100) if value != 255 else -1 for value in m.tilt.tolist())
    return [*grid_head(m), *degrees]


def compass(m: Values) -> Rows:
    x, y, z, w = m["orientation"].values()
    roll, pitch = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)), math.asin(2 * (w * y - z * x))
    east = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return [roll, pitch, (math.pi / 2 - east) % math.tau, *xyz(m["linear_acceleration"])]


def lens_source(_: CompressedImage) -> Rows:
    lens = LensConfig()
    matrix = [lens.focal_x, 0, lens.centre_x, 0, lens.focal_y, lens.centre_y, 0, 0, 1]
    return [lens.width, lens.height, *matrix, lens.k1, lens.k2, lens.p1, lens.p2, lens.k3]


def marked(kind: int) -> Callable[[Values], Rows]:
    """Return the places and texts of the markers of one kind."""

    def rows(m: Values) -> Rows:
        found = [one for one in m["markers"] if one["type"] == kind and one["action"] == 0]
        return [value for one in found for value in (*place_of(one["pose"]), one["text"])]

    return rows


def corners(m: Values) -> Rows:
    (line,) = (one for one in m["markers"] if one["type"] == 4 and one["action"] == 0)
    return [value for point in line["points"][:-1] for value in (point["x"], point["y"])]


def sonar(name: str) -> Callable[[SonarRanges], Rows]:
    """Return range and limits of one sonar."""

    def row(m: SonarRanges) -> Rows:
        (echo,) = (one for one in m.sonars if one.name == name)
        distance = math.nan if not echo.answered else math.inf if echo.range is None else echo.range
        return [distance, m.range_min, m.range_max, m.field_of_view]

    return row


def ranged(m: Values) -> Rows:
    return [m["range"], m["min_range"], m["max_range"], m["field_of_view"]]


@dataclass(frozen=True, slots=True)
class Compared:
    """A topic of ROS 2 with the source of its values."""

    interface: str
    source: Topic[Any]
    values: Callable[[Values], Rows]
    own: Callable[[Any], Rows]
    latched: bool = False
    reliable: bool = True
    some: bool = False
    """Whether only some of the source's messages are published, by their change or at a lower rate."""


MARKERS, IMAGES = "visualization_msgs/msg/MarkerArray", "camera/image_raw/compressed"

COMPARED: dict[str, Compared] = {
    "/scan": Compared(
        "sensor_msgs/msg/LaserScan", t.SCAN,
        lambda m: [m["angle_min"], m["angle_max"], m["range_max"], *m["ranges"]], scan_source, reliable=False,
    ),
    "/odom": Compared("nav_msgs/msg/Odometry", t.ODOMETRY, odom, odom_source),
    "/tf odom": Compared("tf2_msgs/msg/TFMessage", t.ODOMETRY, transform, base_source),
    "/tf map": Compared("tf2_msgs/msg/TFMessage", t.TRANSFORMS, transform, map_source),
    "/pose": Compared(
        "geometry_msgs/msg/PoseWithCovarianceStamped", t.POSE, lambda m: planar(m["pose"]), pose_source
    ),
    "/map": Compared(
        "nav_msgs/msg/OccupancyGrid", t.MAP, whole, lambda m: [*grid_head(m), *m.cells], latched=True
    ),
    "/map_updates": Compared(
        "map_msgs/msg/OccupancyGridUpdate", t.MAP_TILES,
        lambda m: [m["x"], m["y"], m["width"], m["height"], *m["data"]], lambda m: [0, 0, 64, 64, *m.cells],
    ),
    "/ground_tilt": Compared("nav_msgs/msg/OccupancyGrid", t.GROUND, whole, ground_source, latched=True),
    "/seen_ground": Compared(
        "nav_msgs/msg/OccupancyGrid", t.SEEN, whole, lambda m: [*grid_head(m), *m.cells], latched=True
    ),
    "/plan": Compared(
        "nav_msgs/msg/Path", t.PATH, lambda m: [value for row in m["poses"] for value in place_of(row["pose"])],
        lambda m: [v for row in m.poses.reshape(-1, 3) for v in (*row[:2], math.remainder(row[2], math.tau))],
        latched=True,
    ),
    "/battery_state": Compared(
        "sensor_msgs/msg/BatteryState", t.BATTERY,
        lambda m: [m["voltage"], m["percentage"], m["design_capacity"], m["current"], m["power_supply_status"]],
        lambda m: [m.voltage, m.charge, m.capacity_ah, m.current, 2],
    ),
    "/imu": Compared(
        "sensor_msgs/msg/Imu", t.IMU, lambda m: [*xyz(m["angular_velocity"]), *xyz(m["linear_acceleration"])],
        lambda m: [*xyz(m.angular_velocity), *xyz(m.linear_acceleration)], reliable=False,
    ),
    "/compass": Compared(
        "sensor_msgs/msg/Imu", t.COMPASS, compass, lambda m: [m.roll, m.pitch, m.heading, *xyz(m.acceleration)],
        reliable=False,
    ),
    "/joint_states": Compared(
        "sensor_msgs/msg/JointState", t.DRIVE,
        lambda m: [m["position"][m["name"].index("front_left_spin")]], lambda m: [m.position / RATIO],
    ),
    f"/{IMAGES}": Compared(
        "sensor_msgs/msg/CompressedImage", t.CAMERA, lambda m: [m["format"], bytes(m["data"])],
        lambda m: [m.format, m.data], reliable=False,
    ),
    "/camera/camera_info": Compared(
        "sensor_msgs/msg/CameraInfo", t.CAMERA, lambda m: [m["width"], m["height"], *m["k"], *m["d"]], lens_source,
        reliable=False,
    ),
    **{
        f"/sonar_{name}": Compared("sensor_msgs/msg/Range", t.SONAR, ranged, sonar(name), reliable=False)
        for name in ("left", "right", "rear")
    },
    "/points": Compared(
        MARKERS, t.POINTS, marked(9), lambda m: [v for p in m.points for v in (p.x, p.y, p.yaw, p.name)], latched=True
    ),
    "/zones": Compared(MARKERS, t.ZONES, corners, lambda m: [v for c in m.zones[0].corners for v in c], latched=True),
    "/tasks goal": Compared(MARKERS, t.GOAL, lambda m: place_of(m["pose"]), lambda m: own_place(m.goal), some=True),
    "/tasks frontier": Compared(
        MARKERS, t.EXPLORE, lambda m: place_of(m["pose"]), lambda m: own_place(m.target), some=True
    ),
    "/tasks peers": Compared(
        MARKERS, t.PEERS, lambda m: place_of(m["pose"]), lambda m: own_place(m.peers[0].pose), some=True
    ),
    "/rosout event": Compared(
        "rcl_interfaces/msg/Log", t.EVENT, lambda m: [m["level"], m["name"], m["msg"]],
        lambda m: [30, m.source, f"{m.reason.value}: {m.text}"],
    ),
    "/rosout log": Compared(
        "rcl_interfaces/msg/Log", t.LOG, lambda m: [m["level"], m["name"], m["msg"], m["file"], m["line"]],
        lambda m: [20, m.name, m.text, m.file, m.line],
    ),
}  # fmt: skip
"""By topic of ROS 2; a word behind it names one of several sources."""
OTHERS = {
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/robot_description": "std_msgs/msg/String",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "/gate": MARKERS,
    "/footprint": "geometry_msgs/msg/PolygonStamped",
}
"""Topics without a source of the same stamp."""
TOPICS = {name.split()[0]: row.interface for name, row in COMPARED.items()} | OTHERS
"""Interfaces by topic."""
LATCHED = {name for name, row in COMPARED.items() if row.latched} | {"/tf_static", "/robot_description", "/rosout"}
BEST_EFFORT = {name for name, row in COMPARED.items() if not row.reliable}


def nanoseconds(stamp: Values) -> int:
    """Return the time of a stamp."""
    return int(stamp["sec"]) * SECOND + int(stamp["nanosec"])


def parts(topic: str, m: Values) -> Iterator[tuple[str, Values, int]]:
    """Split a message by its sources: name in ``COMPARED``, part, and stamp (ns)."""
    if topic == "/tf":
        for row in m["transforms"]:
            name = {"odom": "/tf map", "base_link": "/tf odom"}[row["child_frame_id"]]
            yield name, row, nanoseconds(row["header"]["stamp"])
    elif topic == "/tasks":
        for row in m["markers"]:
            if row["type"] == 0 and row["action"] == 0:
                yield f"/tasks {row['ns']}", row, nanoseconds(row["header"]["stamp"])
    elif topic == "/rosout":
        yield f"/rosout {'log' if m['file'] else 'event'}", m, nanoseconds(m["stamp"])
    elif topic in COMPARED:
        header = m["markers"][0]["header"] if "markers" in m else m["header"]
        yield topic, m, nanoseconds(header["stamp"])


def same(found: Rows, expected: Rows) -> bool:
    """Whether values agree: numbers within 32 bits, texts exactly."""

    def split(rows: Rows) -> tuple[Any, list[Any]]:
        texts = [value for value in rows if isinstance(value, (str, bytes))]
        numbers = [value for value in rows if not isinstance(value, (str, bytes))]
        return np.array(numbers, float), texts

    (numbers, texts), (own_numbers, own_texts) = split(found), split(expected)
    equal = numbers.shape == own_numbers.shape and np.allclose(numbers, own_numbers, 1e-6, 1e-6, equal_nan=True)
    return equal and texts == own_texts


def compared(ros: Mapping[str, list[Values]], sources: Mapping[Topic[Any], list[Any]], offset: int) -> dict[str, Any]:
    """Return the number of messages with a source of the same stamp, of differing ones, and the least received share.

    Args:
        ros: messages read by a node, by topic.
        sources: messages published by the robot.
        offset: real time minus the robot's, ns.
    """
    rows: dict[str, list[tuple[Values, int]]] = {name: [] for name in COMPARED}
    for topic, messages in ros.items():
        for message in messages:
            for name, part, stamp in parts(topic, message):
                rows[name].append((part, stamp - offset))
    odometry = [stamp for _, stamp in rows["/odom"]]
    first, last = (min(odometry) + SECOND, max(odometry) - SECOND) if odometry else (0, 0)
    figures: dict[str, Any] = {"messages": {}, "unequal": [], "unmatched": 0, "least_rate": 1.0}
    for name, row in COMPARED.items():
        by_stamp = {message.stamp: message for message in sources[row.source]}
        stamps = np.array(sorted(by_stamp), np.int64)
        within = [int(stamp) for stamp in stamps if first <= stamp < last]
        found: set[int] = set()
        for part, stamp in rows[name]:
            nearest = int(stamps[np.abs(stamps - stamp).argmin()]) if len(stamps) else 0
            if abs(nearest - stamp) > 2_000_000:  # ns: the face follows the offset in steps of 1 ms
                figures["unmatched"] += 1
                continue
            found.add(nearest)
            if not same(row.values(part), row.own(by_stamp[nearest])):
                figures["unequal"].append(name)
        came = len(found.intersection(within))
        figures["messages"][name] = [came, len(within)]
        if not row.some and within:
            figures["least_rate"] = round(min(figures["least_rate"], came / len(within)), 3)
    figures["silent"] = [name for name in COMPARED if not rows[name]] + [name for name in OTHERS if not ros.get(name)]
    figures["unequal"] = {name: figures["unequal"].count(name) for name in sorted(set(figures["unequal"]))}
    return figures
