"""The robot on a ROS 2 node: publishes its topics and accepts requests of ROS 2 nodes."""

import asyncio
import math
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

from monstertruck_estimation.transforms import FIXED, mount, yaw_of
from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import NoAnswerError, RequestRefusedError, TruckError
from monstertruck_runtime.mailbox import Mailbox, fifo
from monstertruck_schemas import topics as t
from monstertruck_schemas.event import Event, LogRecord
from monstertruck_schemas.plan import Path
from monstertruck_schemas.points import PointsOfInterest
from monstertruck_schemas.req import Order
from monstertruck_schemas.sensor import (
    Attitude,
    Battery,
    CompressedImage,
    DriveFeedback,
    Imu,
    LaserScan,
    SonarRanges,
    StabiliserFeedback,
    SteeringFeedback,
)
from monstertruck_schemas.state import ClockOffset, Grid, Ground, Odometry, Transforms
from monstertruck_schemas.topics import Topic
from monstertruck_schemas.zones import Zones
from monstertruckd.ros2 import convert
from monstertruckd.ros2.cdr import RosMessage
from monstertruckd.ros2.facts import RobotFacts, renamed_links
from monstertruckd.ros2.localisation import RosLocalisation, RosMaps
from monstertruckd.ros2.navigation import GoalPose, Navigation
from monstertruckd.ros2.node import RosArrival, RosNode, RosSender
from monstertruckd.ros2.operators import LEASE, Operators, check_age, check_header, frame_in, planar_twist
from monstertruckd.ros2.parameters import RosParameters
from monstertruckd.ros2.rmw import LATCHED, RELIABLE, SENSOR, RosQos

TF: Final = RosQos(depth=100)
"""Quality of service of ``/tf``, as in ``tf2_ros``."""
ROSOUT: Final = RosQos(depth=1000, latched=True)
"""Quality of service of ``/rosout``, as in ``rcl``."""
ORDERS: Final = (Order.ARM, Order.DISARM, Order.RESET, Order.ESTOP, Order.STOP)
"""Orders offered as services of the node."""


@dataclass(frozen=True, slots=True)
class FaceOptions:
    """Options of the user."""

    prefix: str = ""
    """Prefix of every frame name, such as ``truck1/``."""
    map_to_odom: bool = True
    """Whether to publish the robot's localisation; False if ROS 2 localises it."""
    odom_to_base: bool = True
    """Whether to publish the odometry as a transform; False if ROS 2 fuses it."""
    clock: bool = False
    """Whether to publish ``/clock``."""
    drives: bool = True
    """Whether ROS 2 nodes may request anything but an emergency stop."""


class RosFace:
    """One robot on one node.

    Args:
        client: client of the robot.
        node: node of ROS 2.
        operators: sessions of the nodes that send requests.
        facts: facts of the robot's configuration.
        options: options of the user.
        clock: time.
    """

    def __init__(
        self,
        client: TruckClient,
        node: RosNode,
        operators: Operators,
        facts: RobotFacts,
        options: FaceOptions,
        clock: Clock,
    ) -> None:
        self._client = client
        self._node = node
        self._operators = operators
        self._facts = facts
        self._options = options
        self._clock = clock
        self._names = convert.RosNames(0, convert.prefixed(options.prefix))
        self._publishers: dict[tuple[str, str], Callable[[Mapping[str, Any]], None]] = {}
        self._odometry = False
        """Whether dead reckoning exists: it updates base in odom more often than the frame tree."""
        self._fixed: list[Any] = []
        """Fixed transforms last published."""
        self._localisation: RosLocalisation | None = None
        self._map: Grid | None = None
        self._steering: SteeringFeedback | None = None
        self._stabiliser: StabiliserFeedback | None = None

    async def run(self, ready: Callable[[], object] = lambda: None) -> None:
        """Serve until cancelled; calls ``ready`` once ROS 2 can discover the robot.

        Raises:
            NoAnswerError: the robot does not publish its clock.
        """
        clock = self._client.subscribe(t.CLOCK, fifo(10))
        try:
            async with self._clock.deadline(5.0):  # seconds to wait for a topic of 1 Hz
                self._follow_clock(await clock.next())
        except TimeoutError:
            raise NoAnswerError(f"robot {self._client.robot!r} does not publish {t.CLOCK.name}") from None
        self._describe()
        self._listen()
        navigation = None
        if self._options.drives:
            RosParameters(self._node, self._operators, self._client)
            if self._facts.plans:
                arguments = self._goal_in, lambda: self._names, self._clock
                navigation = Navigation(self._node, self._operators, self._client, *arguments)
        try:
            await self._serve(clock, ready)
        finally:
            if navigation is not None:
                navigation.close()

    async def _serve(self, clock: Mailbox[ClockOffset], ready: Callable[[], object]) -> None:
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._each(clock, self._follow_clock))
            for topic, take in self._rows():
                tasks.create_task(self._each(self._client.subscribe(topic, fifo(200)), take))
            tasks.create_task(self._diagnose())
            ready()

    @staticmethod
    async def _each(mailbox: Any, take: Callable[[Any], None]) -> None:
        async for message in mailbox:
            take(message)

    def _publish(self, topic: str, interface: str, values: Mapping[str, Any], qos: RosQos = RELIABLE) -> None:
        """Publish; the first message of a topic declares it, so that ROS 2 lists only topics that this robot has."""
        publish = self._publishers.get((topic, interface))
        if publish is None:
            publish = self._publishers[topic, interface] = self._node.publisher(topic, interface, qos)
        publish(values)

    # Outwards

    def _rows(self) -> Iterable[tuple[Topic[Any], Callable[[Any], None]]]:
        """Yield the robot's topics with the handlers of their messages."""
        return (
            (t.SCAN, self._scan),
            (t.SCAN_2, partial(self._scan, topic="scan_2")),
            (t.ODOMETRY, self._odometry_message),
            (t.TRANSFORMS, self._transforms),
            (t.POSE, self._pose),
            *(((t.MAP, self._whole_map), (t.MAP_TILES, self._tile)) if self._facts.mapped else ()),
            (t.GROUND, self._ground),
            (t.SEEN, self._seen),
            (t.PATH, self._path),
            (t.BATTERY, self._battery),
            (t.IMU, self._imu),
            (t.COMPASS, self._compass),
            (t.CAMERA, self._camera),
            (t.SONAR, self._sonars),
            (t.STEERING, self._steered),
            (t.STABILISER, self._stabilised),
            (t.DRIVE, self._driven),
            (t.EVENT, self._event),
            (t.LOG, self._log),
            (t.POINTS, self._points),
            (t.ZONES, self._zones),
        )

    def _follow_clock(self, message: ClockOffset) -> None:
        # Minimum change of the robot's offset to real time that stamps follow, ns: below it, stamps of one drive
        # agree.
        clock_step = SECOND // 1000
        if abs(message.offset - self._names.offset) > clock_step:
            self._names = replace(self._names, offset=message.offset)
        if self._options.clock:
            self._publish("/clock", "rosgraph_msgs/msg/Clock", {"clock": self._names.time(message.stamp)})

    def _describe(self) -> None:
        if self._facts.description is not None:
            text = renamed_links(self._facts.description, self._names.frame)
            self._publish("robot_description", "std_msgs/msg/String", {"data": text}, LATCHED)

    def _scan(self, message: LaserScan, topic: str = "scan") -> None:
        self._publish(topic, "sensor_msgs/msg/LaserScan", convert.scan(message, self._names), SENSOR)

    def _odometry_message(self, message: Odometry) -> None:
        self._odometry = True
        if self._localisation is not None:
            self._localisation.observe(message)
        values = convert.odometry(message, self._names)
        self._publish("odom", "nav_msgs/msg/Odometry", values)
        if self._options.odom_to_base:
            place = values["pose"]["pose"]
            transform = {"translation": place["position"], "rotation": place["orientation"]}
            row = {"header": values["header"], "child_frame_id": values["child_frame_id"], "transform": transform}
            self._publish("/tf", "tf2_msgs/msg/TFMessage", {"transforms": [row]}, TF)

    def _transforms(self, message: Transforms) -> None:
        moving, fixed = [], []
        for row in message.transforms:
            if row.child == "odom":
                moving += [row] if self._options.map_to_odom and self._facts.localised else []
            elif row.child == "base":
                moving += [row] if self._options.odom_to_base and not self._odometry else []
            elif row.child == "stabiliser":
                moving.append(row)
            else:
                fixed.append(row.model_copy(update={"stamp": FIXED}))
        if moving:
            self._publish("/tf", "tf2_msgs/msg/TFMessage", convert.transforms(moving, self._names), TF)
        if fixed != self._fixed:
            self._fixed = fixed
            now = message.stamp
            rows = [row.model_copy(update={"stamp": now}) for row in (*fixed, *_further_frames(fixed))]
            self._publish("/tf_static", "tf2_msgs/msg/TFMessage", convert.transforms(rows, self._names), LATCHED)

    def _pose(self, message: Odometry) -> None:
        self._publish("pose", "geometry_msgs/msg/PoseWithCovarianceStamped", convert.pose(message, self._names))

    def _whole_map(self, message: Grid) -> None:
        before, self._map = self._map, message
        header = {"stamp": 0, "received": 0, "seq": 0}
        if before is not None and before.model_copy(update=header) == message.model_copy(update=header):
            return  # latched already
        self._publish("map", "nav_msgs/msg/OccupancyGrid", convert.grid(message, self._names), LATCHED)

    def _tile(self, message: Grid) -> None:
        if self._map is not None:
            values = convert.grid_update(message, self._map, self._names)
            if values is not None:
                self._publish("map_updates", "map_msgs/msg/OccupancyGridUpdate", values)

    def _ground(self, message: Ground) -> None:
        self._publish("ground_tilt", "nav_msgs/msg/OccupancyGrid", convert.ground(message, self._names), LATCHED)

    def _seen(self, message: Grid) -> None:
        self._publish("seen_ground", "nav_msgs/msg/OccupancyGrid", convert.grid(message, self._names), LATCHED)

    def _path(self, message: Path) -> None:
        self._publish("plan", "nav_msgs/msg/Path", convert.path(message, self._names), LATCHED)

    def _battery(self, message: Battery) -> None:
        self._publish("battery_state", "sensor_msgs/msg/BatteryState", convert.battery(message, self._names))

    def _imu(self, message: Imu) -> None:
        self._publish("imu", "sensor_msgs/msg/Imu", convert.imu(message, self._names), SENSOR)

    def _compass(self, message: Attitude) -> None:
        self._publish("compass", "sensor_msgs/msg/Imu", convert.compass(message, self._names), SENSOR)

    def _camera(self, message: CompressedImage) -> None:
        shot = message.model_copy(update={"frame": OPTICAL})
        values = convert.image(shot, self._names)
        self._publish("camera/image_raw/compressed", "sensor_msgs/msg/CompressedImage", values, SENSOR)
        if self._facts.lens is not None:
            values = convert.camera_info(shot, self._facts.lens, self._names)
            self._publish("camera/camera_info", "sensor_msgs/msg/CameraInfo", values, SENSOR)

    def _sonars(self, message: SonarRanges) -> None:
        for echo in message.sonars:
            values = convert.sonar(echo, message, self._names)
            self._publish(f"sonar_{echo.name}", "sensor_msgs/msg/Range", values, SENSOR)

    def _steered(self, message: SteeringFeedback) -> None:
        self._steering = message

    def _stabilised(self, message: StabiliserFeedback) -> None:
        self._stabiliser = message

    def _driven(self, message: DriveFeedback) -> None:
        joints = self._facts.joints
        angles = {} if joints is None else dict(joints.angles(self._steering, message))
        if self._stabiliser is not None:
            mount_angles = {"stabiliser_pitch": self._stabiliser.pitch, "stabiliser_roll": self._stabiliser.roll}
            angles |= {name: angle for name, angle in mount_angles.items() if angle is not None}
        if angles:
            values = convert.joint_states(message.stamp, angles, self._names)
            self._publish("joint_states", "sensor_msgs/msg/JointState", values)

    def _event(self, message: Event) -> None:
        self._publish("/rosout", "rcl_interfaces/msg/Log", convert.event(message, self._names), ROSOUT)

    def _log(self, message: LogRecord) -> None:
        self._publish("/rosout", "rcl_interfaces/msg/Log", convert.log_record(message, self._names), ROSOUT)

    def _points(self, message: PointsOfInterest) -> None:
        values = convert.point_markers(message, self._names)
        self._publish("points", "visualization_msgs/msg/MarkerArray", values, LATCHED)

    def _zones(self, message: Zones) -> None:
        values = convert.zone_markers(message, self._names)
        self._publish("zones", "visualization_msgs/msg/MarkerArray", values, LATCHED)

    async def _diagnose(self) -> None:
        """Publish once per second the state of services, gate and this node, and the footprint."""
        watch = self._client.watch
        gate, health = watch(t.GATE), watch(t.HEALTH)
        goal, exploration, peers = watch(t.GOAL), watch(t.EXPLORE), watch(t.PEERS)
        size = self._facts.length, self._facts.width
        while True:
            await self._clock.sleep(1.0)
            await self._operators.leave_absent(self._node.present)
            robot, rows = self._client.robot, [self._own_status()]
            if health.latest is not None:
                rows += convert.service_states(health.latest, robot)
            if gate.latest is not None:
                rows.append(convert.gate_status(gate.latest, robot))
                markers = convert.gate_markers(gate.latest, *size, self._names)
                self._publish("gate", "visualization_msgs/msg/MarkerArray", markers)
            tasks = convert.task_markers(goal.latest, exploration.latest, peers.latest, self._names)
            self._publish("tasks", "visualization_msgs/msg/MarkerArray", tasks)
            header = {"stamp": self._names.time(self._clock.now() + self._clock.real_offset() - self._names.offset)}
            self._publish("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", {"header": header, "status": rows})
            placed = header | {"frame_id": self._names.frame("base")}
            outline = {"header": placed, "polygon": {"points": convert.outline(*size)}}
            self._publish("footprint", "geometry_msgs/msg/PolygonStamped", outline)

    def _own_status(self) -> RosMessage:
        operators, malformed = self._operators, self._node.malformed
        values = {
            "refused": operators.refused,
            "malformed": malformed,
            "last refusal": operators.last_refusal,
            "operators": ", ".join(operators.sources),
        }
        level = convert.WARN if operators.refused or malformed else convert.OK
        text = operators.last_refusal or "requests of ROS 2 nodes are passed on"
        return convert.status("ros2", level, text, values, self._client.robot)

    # Inwards

    def _listen(self) -> None:
        for order in ORDERS if self._options.drives else (Order.ESTOP,):
            self._node.serve(f"~/{order.value}", "std_srvs/srv/Trigger", partial(self._order, order))
        self._node.subscribe("estop", "std_msgs/msg/Empty", self._estop)
        if not self._options.drives:
            return
        self._node.subscribe("cmd_vel", "geometry_msgs/msg/Twist", self._twist)
        self._node.subscribe("cmd_vel", "geometry_msgs/msg/TwistStamped", self._twist_stamped)
        self._node.subscribe("ackermann_cmd", "ackermann_msgs/msg/AckermannDriveStamped", self._ackermann)
        if self._facts.plans:
            self._node.subscribe("goal_pose", "geometry_msgs/msg/PoseStamped", self._goal)
        if self._facts.localised:
            interface = "geometry_msgs/msg/PoseWithCovarianceStamped"
            self._node.subscribe("initialpose", interface, self._initial_pose)
        else:
            self._localisation = RosLocalisation(self._node, self._operators, lambda: self._names, self._clock)
        if not self._facts.mapped:
            RosMaps(self._node, self._operators, lambda: self._names)

    async def _order(self, order: Order, _: RosMessage, sender: RosSender | None) -> Mapping[str, Any]:
        if order is Order.ESTOP:
            return await _outcome(self._client.order(order))
        if sender is None:
            self._operators.refuse("an unknown client", order.value, "the graph has no client with its identity")
            return {"success": False, "message": "the graph has no client of this service with this identity"}
        try:
            client = await self._operators.session(sender)
        except TruckError as error:
            return {"success": False, "message": str(error)}
        return await _outcome(client.order(order))

    def _estop(self, arrival: RosArrival) -> None:
        """Forward an emergency stop; it is never refused, regardless of its sender and age."""
        node = "an unknown publisher" if arrival.sender is None else arrival.sender.node
        self._operators.run(node, "estop", self._client.order(Order.ESTOP))

    def _base_frames(self) -> tuple[str, ...]:
        return tuple(self._names.frame(frame) for frame in ("base", convert.FOOTPRINT))

    def _twist(self, arrival: RosArrival) -> None:
        self._drive_twist(arrival, arrival.message, lambda _: None)

    def _twist_stamped(self, arrival: RosArrival) -> None:
        header = arrival.message["header"]
        self._drive_twist(arrival, arrival.message["twist"], lambda now: check_header(header, now, self._base_frames()))

    def _drive_twist(self, arrival: RosArrival, twist: RosMessage, check: Callable[[int], None]) -> None:
        def checked(now: int) -> None:
            check(now)
            planar_twist(twist)

        sender = self._operators.accepted("cmd_vel", arrival, checked)
        if sender is not None:
            motion = planar_twist(twist)
            self._operators.drive(sender, "cmd_vel", lambda client: client.drive_twist(*motion, lease=LEASE))

    def _ackermann(self, arrival: RosArrival) -> None:
        header, drive = arrival.message["header"], arrival.message["drive"]
        sender = self._operators.accepted(
            "ackermann_cmd", arrival, lambda now: check_header(header, now, self._base_frames())
        )
        if sender is not None:
            motion = drive["speed"], drive["steering_angle"]
            self._operators.drive(sender, "ackermann_cmd", lambda client: client.drive(*motion, lease=LEASE))

    def _goal(self, arrival: RosArrival) -> None:
        goal = arrival.message

        def check(now: int) -> None:
            check_age("its header's stamp", goal["header"], now)
            self._goal_in(goal)

        sender = self._operators.accepted("goal_pose", arrival, check)
        if sender is not None:
            pose, frame = self._goal_in(goal)
            self._operators.ask(sender, "goal_pose", lambda client: client.goal(pose, frame))

    def _goal_in(self, goal: RosMessage) -> GoalPose:
        """Read the pose of a ``geometry_msgs/msg/PoseStamped``.

        Raises:
            InputError: its frame is neither map nor odom.
        """
        frames = {self._names.frame(frame): frame for frame in ("map", "odom")}
        frame = frame_in(goal["header"], (*frames,)) or next(iter(frames))
        position, orientation = goal["pose"]["position"], goal["pose"]["orientation"]
        yaw = yaw_of((orientation["x"], orientation["y"], orientation["z"], orientation["w"]))
        return (position["x"], position["y"], yaw), frames[frame]

    def _initial_pose(self, arrival: RosArrival) -> None:
        node = "an unknown publisher" if arrival.sender is None else arrival.sender.node
        self._operators.refuse(node, "initialpose", "the robot localises itself by its own scans")


OPTICAL: Final = "camera_optical"
"""Frame of the camera by the optical convention: z forward, x right, y down."""


def _further_frames(fixed: Iterable[Any]) -> list[Any]:
    """Return the additional fixed transforms that ROS 2 expects."""
    frames = [mount(convert.FOOTPRINT, (0.0, 0.0, 0.0))]
    if any(row.child == "camera" for row in fixed):
        half = math.pi / 2  # rotation from x forward, y left, z up to z forward, x right, y down
        frames.append(mount(OPTICAL, (0.0, 0.0, 0.0), (-half, 0.0, -half), parent="camera"))
    return frames


async def _outcome(order: Awaitable[Any]) -> Mapping[str, Any]:
    """Return the answer of ``std_srvs/srv/Trigger``."""
    try:
        state = await order
    except TruckError as error:
        reason = error.refusal if isinstance(error, RequestRefusedError) else error.reason
        return {"success": False, "message": f"{reason.value}: {error}"}
    return {"success": True, "message": state.mode_text}
