"""Conversion of the robot's messages to ROS 2 messages, by ROS conventions (REP 103, 105, 117 and 145).

Values are dictionaries by field, for ``cdr.encode``. ``RosNames`` converts stamps and frame names.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from monstertruck_estimation.transforms import Quaternion, quaternion_from_rpy, quaternion_from_yaw
from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Message, Pose2D
from monstertruck_schemas.body import LensConfig
from monstertruck_schemas.event import Event, LogLevel, LogRecord, Severity
from monstertruck_schemas.health import HealthTable, ServiceState
from monstertruck_schemas.plan import ExplorationState, GoalState, Path
from monstertruck_schemas.points import PointsOfInterest
from monstertruck_schemas.sensor import (
    NO_ECHO,
    VALID_BEAM,
    Attitude,
    Battery,
    CompressedImage,
    Imu,
    LaserScan,
    SonarEcho,
    SonarRanges,
)
from monstertruck_schemas.state import TILT_STEP, GateMode, GateState, Grid, Ground, Odometry, Peers, Transform
from monstertruck_schemas.zones import Zones

RosValues = dict[str, Any]

FRAMES: Final = {"base": "base_link", "lidar": "laser", "lidar_2": "laser_2"}
"""Frames with other names in ROS."""


FOOTPRINT: Final = "base_footprint"
"""Projection of base onto the ground; identical to base on this robot."""


def _own_name(frame: str) -> str:
    return frame


@dataclass(frozen=True, slots=True)
class RosNames:
    """Conversion of stamps and frame names."""

    offset: int = 0
    """Real time minus robot time (ns)."""
    frame: Callable[[str], str] = _own_name
    """Returns the ROS name of a frame of the robot."""

    def time(self, stamp: int) -> RosValues:
        """``builtin_interfaces/msg/Time`` for the robot's time, limited to the end of the format in 2038."""
        last = 2**31 * SECOND - 1  # last time that a ``builtin_interfaces/msg/Time`` can hold, ns
        seconds, nanoseconds = divmod(min(max(0, stamp + self.offset), last), SECOND)
        return {"sec": seconds, "nanosec": nanoseconds}

    def header(self, message: Message) -> RosValues:
        """``std_msgs/msg/Header`` of a message of the robot."""
        return self.header_of(message.stamp, message.frame)

    def header_of(self, stamp: int, frame: str) -> RosValues:
        """``std_msgs/msg/Header``."""
        return {"stamp": self.time(stamp), "frame_id": self.frame(frame)}


def prefixed(prefix: str) -> Callable[[str], str]:
    """Return the conversion of the robot's frame names to ROS names with a prefix such as ``truck1/``."""
    return lambda frame: f"{prefix}{FRAMES.get(frame, frame)}"


def vector(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> RosValues:
    """``geometry_msgs/msg/Vector3`` or ``Point``."""
    return {"x": x, "y": y, "z": z}


def rotation(quaternion: Quaternion) -> RosValues:
    """``geometry_msgs/msg/Quaternion``."""
    return dict(zip("xyzw", quaternion, strict=True))


def pose_of(pose: Pose2D, z: float = 0.0) -> RosValues:
    """``geometry_msgs/msg/Pose``."""
    return {"position": vector(pose.x, pose.y, z), "orientation": rotation(quaternion_from_yaw(pose.yaw))}


_PLANE: Final = np.array([6 * row + column for row in (0, 1, 5) for column in (0, 1, 5)])
"""Indices of (x, y, yaw) in ROS covariances over (x, y, z, roll, pitch, yaw)."""


def full_covariance(planar: Array) -> Array:
    """Covariance (36,) from the covariance (9,) of x, y, yaw; the other entries are 0."""
    full = np.zeros(36)
    full[_PLANE] = planar
    return full


def scan(message: LaserScan, names: RosNames) -> RosValues:
    """``sensor_msgs/msg/LaserScan``: +inf without a return in range, NaN for an unknown range (REP 117)."""
    with np.errstate(over="ignore"):  # values beyond the range of float32 become infinite
        ranges = message.ranges.astype(np.float32)
    ranges[(message.codes > NO_ECHO) & (message.codes != VALID_BEAM)] = np.nan
    return {
        "header": names.header(message),
        "angle_min": message.start_angle,
        "angle_max": message.end_angle,
        "angle_increment": message.angle_increment,
        "time_increment": message.time_increment,
        "scan_time": message.scan_time,
        "range_min": message.range_min,
        "range_max": message.range_max,
        "ranges": ranges,
        "intensities": () if message.intensities is None else message.intensities,
    }


def odometry(message: Odometry, names: RosNames) -> RosValues:
    """``nav_msgs/msg/Odometry``."""
    twist = message.twist
    return {
        "header": names.header(message),
        "child_frame_id": names.frame(message.child),
        "pose": {"pose": pose_of(message.pose), "covariance": full_covariance(message.pose_covariance)},
        "twist": {
            "twist": {"linear": vector(twist.vx, twist.vy), "angular": vector(z=twist.wz)},
            "covariance": full_covariance(message.twist_covariance),
        },
    }


def pose(message: Odometry, names: RosNames) -> RosValues:
    """``geometry_msgs/msg/PoseWithCovarianceStamped``."""
    covariance = full_covariance(message.pose_covariance)
    return {"header": names.header(message), "pose": {"pose": pose_of(message.pose), "covariance": covariance}}


def transforms(rows: Iterable[Transform], names: RosNames) -> RosValues:
    """``tf2_msgs/msg/TFMessage``."""
    return {
        "transforms": [
            {
                "header": names.header_of(row.stamp, row.parent),
                "child_frame_id": names.frame(row.child),
                "transform": {"translation": vector(*row.translation), "rotation": rotation(row.rotation)},
            }
            for row in rows
        ]
    }


def image(message: CompressedImage, names: RosNames) -> RosValues:
    """``sensor_msgs/msg/CompressedImage``."""
    return {"header": names.header(message), "format": message.format, "data": message.data}


def camera_info(message: CompressedImage, lens: LensConfig, names: RosNames) -> RosValues:
    """``sensor_msgs/msg/CameraInfo``: pinhole with Brown distortion, as in the lens calibration."""
    fx, fy, cx, cy = lens.focal_x, lens.focal_y, lens.centre_x, lens.centre_y
    return {
        "header": names.header(message),
        "height": lens.height,
        "width": lens.width,
        "distortion_model": "plumb_bob",
        "d": (lens.k1, lens.k2, lens.p1, lens.p2, lens.k3),
        "k": (fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0),
        "r": (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0),
        "p": (fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0),
    }


def grid(message: Grid, names: RosNames) -> RosValues:
    """``nav_msgs/msg/OccupancyGrid``."""
    info = {
        "map_load_time": names.time(message.stamp),
        "resolution": message.resolution,
        "width": message.width,
        "height": message.height,
        "origin": pose_of(message.origin),
    }
    return {"header": names.header(message), "info": info, "data": message.cells}


def ground(message: Ground, names: RosNames) -> RosValues:
    """``nav_msgs/msg/OccupancyGrid`` of the ground's tilt in degrees, at most 100; -1 if unknown."""
    degrees = np.minimum(np.rint(np.degrees(message.tilt * TILT_STEP)), 100)
    cells = np.where(message.tilt == 255, -1, degrees).astype(np.int8)  # 255: not known
    info = {
        "map_load_time": names.time(message.stamp),
        "resolution": message.resolution,
        "width": message.width,
        "height": message.height,
        "origin": pose_of(message.origin),
    }
    return {"header": names.header(message), "info": info, "data": cells}


def grid_update(tile: Grid, whole: Grid, names: RosNames) -> RosValues | None:
    """``map_msgs/msg/OccupancyGridUpdate``: the part of ``tile`` on the ``whole`` grid; None if they do not overlap."""
    column = round((tile.origin.x - whole.origin.x) / whole.resolution)
    row = round((tile.origin.y - whole.origin.y) / whole.resolution)
    left, bottom = max(column, 0), max(row, 0)
    right, top = min(column + tile.width, whole.width), min(row + tile.height, whole.height)
    if left >= right or bottom >= top:
        return None
    cells = tile.cells.reshape(tile.height, tile.width)[bottom - row : top - row, left - column : right - column]
    size = {"x": left, "y": bottom, "width": right - left, "height": top - bottom}
    return {"header": names.header(tile), **size, "data": cells.ravel()}


def path(message: Path, names: RosNames) -> RosValues:
    """``nav_msgs/msg/Path``, which has no fields for direction and steering."""
    header = names.header(message)
    rows = message.poses.reshape(-1, 3).tolist()
    return {
        "header": header,
        "poses": [{"header": header, "pose": pose_of(Pose2D(x=x, y=y, yaw=yaw))} for x, y, yaw in rows],
    }


def _known(value: float | None) -> float:
    return math.nan if value is None else value


def battery(message: Battery, names: RosNames) -> RosValues:
    """``sensor_msgs/msg/BatteryState``; unknown values are NaN."""
    capacity, share = _known(message.capacity_ah), _known(message.charge)
    charging, discharging = 1, 2
    return {
        "header": names.header(message),
        "voltage": _known(message.voltage),
        "temperature": math.nan,
        "current": _known(message.current),
        "charge": capacity * share,
        "capacity": math.nan,
        "design_capacity": capacity,
        "percentage": share,
        "power_supply_status": charging if (message.current or 0.0) > 0.0 else discharging,
        "present": True,
    }


UNKNOWN: Final = (-1.0, *(0.0,) * 8)
"""Covariance of a quantity that a ``sensor_msgs/msg/Imu`` does not measure."""


def imu(message: Imu, names: RosNames) -> RosValues:
    """``sensor_msgs/msg/Imu`` without an orientation; covariances of 0 mean unknown."""
    return {
        "header": names.header(message),
        "orientation": rotation((0.0, 0.0, 0.0, 1.0)),
        "orientation_covariance": UNKNOWN,
        "angular_velocity": message.angular_velocity.model_dump(),
        "linear_acceleration": message.linear_acceleration.model_dump(),
    }


def compass(message: Attitude, names: RosNames) -> RosValues:
    """``sensor_msgs/msg/Imu`` with an orientation from magnetic east, as REP 145 requires, and no angular velocity."""
    yaw = math.remainder(math.pi / 2.0 - message.heading, math.tau)
    acceleration = message.acceleration
    return {
        "header": names.header(message),
        "orientation": rotation(quaternion_from_rpy(message.roll, message.pitch, yaw)),
        "orientation_covariance": UNKNOWN if message.heading_disturbed else (0.0,) * 9,
        "angular_velocity_covariance": UNKNOWN,
        "linear_acceleration": {} if acceleration is None else acceleration.model_dump(),
        "linear_acceleration_covariance": UNKNOWN if acceleration is None else (0.0,) * 9,
    }


def sonar(echo: SonarEcho, message: SonarRanges, names: RosNames) -> RosValues:
    """``sensor_msgs/msg/Range``: +inf without an echo, NaN for a sonar that does not answer."""
    distance = math.nan if not echo.answered else math.inf if echo.range is None else echo.range
    return {
        "header": names.header_of(echo.stamp, f"sonar_{echo.name}"),
        "radiation_type": 0,  # ultrasound
        "field_of_view": message.field_of_view,
        "min_range": message.range_min,
        "max_range": message.range_max,
        "range": distance,
    }


def joint_states(stamp: int, angles: Mapping[str, float], names: RosNames) -> RosValues:
    """``sensor_msgs/msg/JointState`` of angles (rad), by joint of the robot description."""
    header = {"stamp": names.time(stamp), "frame_id": ""}
    return {"header": header, "name": list(angles), "position": list(angles.values())}


LOG_LEVELS: Final = {
    LogLevel.DEBUG: 10,
    LogLevel.INFO: 20,
    LogLevel.WARNING: 30,
    LogLevel.ERROR: 40,
    LogLevel.FATAL: 50,
}
"""Levels of ``rcl_interfaces/msg/Log``."""
SEVERITIES: Final = {Severity.INFO: 20, Severity.WARNING: 30, Severity.ERROR: 40}


def event(message: Event, names: RosNames) -> RosValues:
    """``rcl_interfaces/msg/Log`` of an event: its reason, text and values."""
    values = "".join(f", {name} {value}" for name, value in message.values.items())
    return {
        "stamp": names.time(message.stamp),
        "level": SEVERITIES[message.severity],
        "name": message.source,
        "msg": f"{message.reason.value}: {message.text or message.reason.text}{values}",
    }


def log_record(message: LogRecord, names: RosNames) -> RosValues:
    """``rcl_interfaces/msg/Log`` of a line of the daemon's journal."""
    return {
        "stamp": names.time(message.stamp),
        "level": LOG_LEVELS[message.level],
        "name": message.name,
        "msg": message.text,
        "file": message.file,
        "line": message.line,
    }


OK, WARN, ERROR, STALE = 0, 1, 2, 3
"""Levels of ``diagnostic_msgs/msg/DiagnosticStatus``."""

SERVICE_LEVELS: Final = {
    ServiceState.READY: OK,
    ServiceState.STARTING: WARN,
    ServiceState.STOPPED: WARN,
    ServiceState.BACKOFF: ERROR,
    ServiceState.FAILED: ERROR,
}


def status(name: str, level: int, text: str, values: Mapping[str, Any], robot: str) -> RosValues:
    """``diagnostic_msgs/msg/DiagnosticStatus``."""
    rows = [{"key": key, "value": str(value)} for key, value in values.items() if value not in (None, "", ())]
    return {"level": level, "name": f"{robot}: {name}", "message": text, "hardware_id": robot, "values": rows}


def service_states(table: HealthTable, robot: str) -> list[RosValues]:
    """``diagnostic_msgs/msg/DiagnosticStatus`` of every service."""
    return [
        status(
            row.name,
            SERVICE_LEVELS[row.state],
            row.detail or row.state.value,
            {"state": row.state.value, "reason": row.reason.value, "restarts": row.restarts},
            robot,
        )
        for row in table.services
    ]


def gate_status(gate: GateState, robot: str) -> RosValues:
    """``diagnostic_msgs/msg/DiagnosticStatus`` of the safety gate: the driver, and the limits of the robot."""
    level = ERROR if gate.mode is GateMode.ESTOPPED else WARN if gate.hindrances else OK
    values = {
        "mode": gate.mode_text,
        "holder": gate.holder,
        "role": gate.role and gate.role.value,
        "speed_limit": f"{gate.speed_limit:.3f}",
        "stopping_distance": f"{gate.stopping_distance:.3f}",
        "reasons": ", ".join(reason.value for reason in gate.reasons),
        "waiting": ", ".join(gate.waiting),
    }
    return status("gate", level, gate.why, values, robot)


POINTS_MARKERS, ZONE_MARKERS, FOOTPRINT_MARKER, STOPPING_MARKER = "points", "zones", "footprint", "stopping_distance"
"""Namespaces of the markers."""

_ARROW, _CYLINDER, _LINE_STRIP, _TEXT = 0, 3, 4, 9
"""Kinds of ``visualization_msgs/msg/Marker``."""


def _marker(header: RosValues, namespace: str, number: int, kind: int, colour: tuple[float, ...]) -> RosValues:
    return {
        "header": header,
        "ns": namespace,
        "id": number,
        "type": kind,
        "pose": {"position": vector(), "orientation": rotation((0.0, 0.0, 0.0, 1.0))},
        "color": dict(zip("rgba", colour, strict=True)),
        "frame_locked": True,
    }


def point_markers(message: PointsOfInterest, names: RosNames) -> RosValues:
    """``visualization_msgs/msg/MarkerArray`` of all points of interest, each with its name."""
    header = names.header_of(message.stamp, "map")
    markers: list[RosValues] = [{"header": header, "ns": POINTS_MARKERS, "action": 3}]  # delete all
    for number, point in enumerate(message.points):
        place = Pose2D(x=point.x, y=point.y, yaw=point.yaw)
        post = _marker(header, POINTS_MARKERS, 2 * number, _CYLINDER, (0.9, 0.5, 0.1, 0.9))
        text = _marker(header, POINTS_MARKERS, 2 * number + 1, _TEXT, (1.0, 1.0, 1.0, 1.0))
        # 0.1, 0.15: m, size of the post and of the letters; 0.2: m from the point up to its name
        markers.append(post | {"pose": pose_of(place, point.z), "scale": vector(0.1, 0.1, 0.1)})
        markers.append(text | {"pose": pose_of(place, point.z + 0.2), "scale": vector(z=0.15), "text": point.name})
    return {"markers": markers}


def zone_markers(message: Zones, names: RosNames) -> RosValues:
    """``visualization_msgs/msg/MarkerArray`` of the polygons of all zones, grey while off; masks are not drawn."""
    header = names.header_of(message.stamp, "map")
    markers: list[RosValues] = [{"header": header, "ns": ZONE_MARKERS, "action": 3}]  # delete all
    for number, zone in enumerate(zone for zone in message.zones if zone.corners):
        colour = (0.9, 0.2, 0.2, 0.9) if zone.kind == "keepout" else (0.9, 0.7, 0.1, 0.9)
        if zone.off_until is not None:
            colour = (0.5, 0.5, 0.5, 0.9)
        words = zone.name if zone.limit is None else f"{zone.name} {zone.limit:g} m/s"
        corners = [vector(x, y) for x, y in zone.corners]
        line = _marker(header, ZONE_MARKERS, 2 * number, _LINE_STRIP, colour)
        text = _marker(header, ZONE_MARKERS, 2 * number + 1, _TEXT, (1.0, 1.0, 1.0, 1.0))
        x, y = (sum(values) / len(corners) for values in zip(*zone.corners, strict=True))
        # 0.03, 0.15: m, width of the line, size of the letters
        markers.append(line | {"scale": vector(0.03), "points": [*corners, corners[0]]})
        markers.append(text | {"pose": pose_of(Pose2D(x=x, y=y, yaw=0.0)), "scale": vector(z=0.15), "text": words})
    return {"markers": markers}


def task_markers(
    goal: GoalState | None, exploration: ExplorationState | None, peers: Peers | None, names: RosNames
) -> RosValues:
    """``visualization_msgs/msg/MarkerArray`` of the goal, the next frontier to explore, and other robots."""
    rows: list[tuple[str, str, Message, Pose2D, tuple[float, ...]]] = []
    if goal is not None and goal.running and goal.goal is not None:
        rows.append(("goal", "", goal, goal.goal, (0.2, 0.4, 0.9, 0.9)))
    if exploration is not None and exploration.running and exploration.target is not None:
        text = f"{exploration.frontiers} frontiers"
        rows.append(("frontier", text, exploration, exploration.target, (0.7, 0.2, 0.8, 0.9)))
    if peers is not None:
        recent = (peer for peer in peers.peers if peers.stamp - peer.heard < 2 * SECOND)  # 2 s: it may have left
        rows += [("peers", peer.robot, peers, peer.pose, (0.1, 0.7, 0.7, 0.9)) for peer in recent]
    markers: list[RosValues] = [{"header": names.header_of(0, "map"), "action": 3}]  # delete all
    for number, (namespace, text, message, place, colour) in enumerate(rows):
        header = names.header_of(message.stamp, message.frame or "map")
        arrow = _marker(header, namespace, 2 * number, _ARROW, colour)
        # 0.3, 0.06: m, length and width of the arrow
        markers.append(arrow | {"pose": pose_of(place), "scale": vector(0.3, 0.06, 0.06)})
        if text:
            words = _marker(header, namespace, 2 * number + 1, _TEXT, (1.0, 1.0, 1.0, 1.0))
            markers.append(words | {"pose": pose_of(place, 0.3), "scale": vector(z=0.15), "text": text})
    return {"markers": markers}


def outline(length: float, width: float) -> list[RosValues]:
    """Return the corners of the robot's footprint around base (m)."""
    x, y = length / 2.0, width / 2.0
    return [vector(*corner) for corner in ((x, y), (-x, y), (-x, -y), (x, -y))]


def gate_markers(gate: GateState, length: float, width: float, names: RosNames) -> RosValues:
    """``visualization_msgs/msg/MarkerArray`` of the robot's footprint, red while stopped, and its stopping point."""
    header = {"frame_id": names.frame("base")}  # stamp 0: where the robot is now
    free = gate.mode in (GateMode.ARMED, GateMode.DRIVING)
    colour = (0.2, 0.8, 0.3, 1.0) if free else (0.9, 0.2, 0.2, 1.0)
    corners = outline(length, width)
    line = _marker(header, FOOTPRINT_MARKER, 0, _LINE_STRIP, colour)
    arrow = _marker(header, STOPPING_MARKER, 0, _ARROW, (0.9, 0.7, 0.1, 0.8))
    backward = gate.twist is not None and gate.twist.vx < 0.0
    front = math.copysign(length / 2.0, -1.0 if backward else 1.0)
    tip = front + math.copysign(max(gate.stopping_distance, 1e-3), front)  # 1e-3: m, an arrow has a length
    return {
        "markers": [
            line | {"scale": vector(0.02), "points": [*corners, corners[0]]},
            # 0.02, 0.05: m, width of the line, and of the arrow's shaft and head
            arrow | {"scale": vector(0.02, 0.05), "points": [vector(front), vector(tip)]},
        ]
    }
