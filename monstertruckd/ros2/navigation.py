"""Nav2 actions, executed by the robot's own planner and tracker, and lifecycle services for Nav2's RViz panel."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import numpy as np

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.drives import DriveReport, follow, run_task
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.health import ServiceState
from monstertruck_schemas.plan import MAX_POSES, GoalState, Path
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import GoalOrder
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.topics import GOAL, HEALTH, ODOMETRY, POSE, TRACKER
from monstertruckd.ros2 import convert
from monstertruckd.ros2.actions import FAILED, ActionServer, GoalStatus, RobotAction
from monstertruckd.ros2.cdr import RosMessage
from monstertruckd.ros2.convert import RosValues
from monstertruckd.ros2.node import RosNode, RosSender
from monstertruckd.ros2.operators import Operators

GoalPose = tuple[tuple[float, float, float], str]
"""x, y (m), yaw (rad), and the robot's frame name."""

PoseReader = Callable[[RosMessage], GoalPose]
"""Reads a ``geometry_msgs/msg/PoseStamped``; raises ``InputError`` for another frame."""


def _require_own_planner(goal: RosMessage) -> None:
    if goal["behavior_tree"]:
        raise InputError("behavior_tree: expected none, the robot plans itself")


def _duration(seconds: float) -> RosValues:
    whole, rest = divmod(seconds, 1.0)
    return {"sec": int(whole), "nanosec": int(rest * SECOND)}


class WaypointStatus(IntEnum):
    """``waypoint_status`` of ``nav2_msgs/msg/WaypointStatus``."""

    PENDING = 0
    COMPLETED = 1
    FAILED = 3


@dataclass(slots=True)
class PosesToReach:
    """Poses of a goal; the robot stops at the last one."""

    poses: list[tuple[float, float, float]]
    """Poses: x, y (m), yaw (rad)."""
    frame: str
    """The robot's frame name."""
    asked: list[RosMessage] = field(default_factory=list)
    """The same poses as ``geometry_msgs/msg/PoseStamped``."""
    passed: int = 0
    """Number of poses passed so far."""

    def statuses(self, passed: int, rest: WaypointStatus) -> list[RosValues]:
        """Return the ``nav2_msgs/msg/WaypointStatus`` of every pose."""
        return [
            {
                "waypoint_status": int(WaypointStatus.COMPLETED if number < passed else rest),
                "waypoint_index": number,
                "waypoint_pose": pose,
                "error_code": FAILED if rest is WaypointStatus.FAILED and number >= passed else 0,
            }
            for number, pose in enumerate(self.asked)
        ]


class GoalAction(RobotAction[PosesToReach]):
    """Drives to one pose, or through several, with the robot's planner.

    Args:
        client: follows the robot's pose.
        pose_in: reads poses.
        names: returns the current conversion of stamps and frames.
        clock: time.
    """

    def __init__(
        self, client: TruckClient, pose_in: PoseReader, names: Callable[[], convert.RosNames], clock: Clock
    ) -> None:
        self._pose_in, self._names, self._clock = pose_in, names, clock
        self._pose = client.watch(POSE)

    async def drive(
        self, driver: TruckClient, work: PosesToReach, show: Callable[[RosValues], None]
    ) -> tuple[Reason, str]:
        """Send the goal and wait for its end."""
        *via, last = work.poses
        end = await run_task(
            driver,
            GOAL,
            ServiceName.GOALS,
            lambda: driver.goal(last, work.frame, via=via),
            lambda: driver.goal_control(GoalOrder.CANCEL, own=True),
            lambda state: show(self._feedback(work, state)),
            arm=False,
            waits=True,
            clock=self._clock,
            to_its_end=True,
        )
        return end.reason, end.text

    def _feedback(self, work: PosesToReach, state: GoalState) -> RosValues:
        pose, names = self._pose.latest, self._names()
        if state.running:
            work.passed = max(work.passed, len(work.poses) - 1 - state.waypoints)
        values: RosValues = {
            "navigation_time": _duration(state.elapsed),
            "number_of_recoveries": state.recoveries,
            "distance_remaining": state.remaining,
            "number_of_poses_remaining": len(work.poses) - work.passed,
            "waypoint_statuses": work.statuses(work.passed, WaypointStatus.PENDING),
        }
        if pose is not None:
            values["current_pose"] = {"header": names.header(pose), "pose": convert.pose_of(pose.pose)}
            if (speed := abs(pose.twist.vx)) > 0.02:  # m/s; below it the time of arrival is unknown
                values["estimated_time_remaining"] = _duration(state.remaining / speed)
        return values


class NavigateToPose(GoalAction):
    """Action ``navigate_to_pose``."""

    name = "navigate_to_pose"
    interface = "nav2_msgs/action/NavigateToPose"

    def read(self, goal: RosMessage) -> PosesToReach:
        """See ``RobotAction``."""
        _require_own_planner(goal)
        pose, frame = self._pose_in(goal["pose"])
        return PosesToReach([pose], frame)


class NavigateThroughPoses(GoalAction):
    """Action ``navigate_through_poses``: the robot passes all poses but the last without a stop."""

    name = "navigate_through_poses"
    interface = "nav2_msgs/action/NavigateThroughPoses"

    def read(self, goal: RosMessage) -> PosesToReach:
        """See ``RobotAction``; since Kilted, poses without a frame use the frame of the message."""
        _require_own_planner(goal)
        asked, header = goal["poses"], {"frame_id": ""}
        if isinstance(asked, dict):  # nav_msgs/msg/Goals
            asked, header = asked["goals"], asked["header"]
        if not asked:
            raise InputError("poses: expected at least one")
        rows = [row if row["header"]["frame_id"] else row | {"header": header} for row in asked]
        poses, frames = zip(*map(self._pose_in, rows), strict=True)
        if len(set(frames)) > 1:
            raise InputError(f"poses in {' and '.join(sorted(set(frames)))}: expected one frame")
        return PosesToReach([*poses], frames[0], rows)

    def result(self, work: PosesToReach, status: GoalStatus) -> RosValues:
        """See ``RobotAction``."""
        passed = len(work.poses) if status is GoalStatus.SUCCEEDED else work.passed
        rest = WaypointStatus.FAILED if status is GoalStatus.ABORTED else WaypointStatus.PENDING
        return {"waypoint_statuses": work.statuses(passed, rest)}


def path_in(message: RosMessage, pose_in: PoseReader, stamp: int) -> Path:
    """Convert a ``nav_msgs/msg/Path``.

    A step whose pose faces against it is driven backward. Planners that compute only positions leave all orientations
    but the last at the identity; such a path is driven forward.

    Args:
        message: the message.
        pose_in: reads a pose.
        stamp: stamp of the path (ns).

    Raises:
        InputError: the path is too short or too long, or its frame is neither map nor odom.
    """
    rows = message["poses"]
    if not 2 <= len(rows) <= MAX_POSES:
        raise InputError(f"path of {len(rows)} poses: expected 2 to {MAX_POSES}")
    frame = pose_in({"header": message["header"], "pose": rows[0]["pose"]})[1]
    poses = np.array([pose_in({"header": message["header"], "pose": row["pose"]})[0] for row in rows])
    directions = np.ones(len(poses))
    if poses[:-1, 2].any():
        step, yaw = np.diff(poses[:, :2], axis=0), poses[1:, 2]
        directions[1:] = np.where(step[:, 0] * np.cos(yaw) + step[:, 1] * np.sin(yaw) < 0.0, -1.0, 1.0)
        directions[0] = directions[1]
    return Path(
        stamp=stamp, received=stamp, seq=0, frame=frame, poses=poses.ravel(), directions=directions, name="ros2"
    )


class FollowPath(RobotAction[Path]):
    """Action ``follow_path``: the robot's tracker follows a path planned in ROS 2.

    Args:
        client: follows the tracker and the robot's pose.
        pose_in: reads poses.
        names: returns the current conversion of stamps and frames.
        clock: time.
    """

    name = "follow_path"
    interface = "nav2_msgs/action/FollowPath"

    def __init__(
        self, client: TruckClient, pose_in: PoseReader, names: Callable[[], convert.RosNames], clock: Clock
    ) -> None:
        self._pose_in, self._names, self._clock = pose_in, names, clock
        self._tracker, self._odometry = client.watch(TRACKER), client.watch(ODOMETRY)

    def read(self, goal: RosMessage) -> Path:
        """See ``RobotAction``; ids of Nav2's plug-ins are ignored: the robot has one tracker."""
        return path_in(goal["path"], self._pose_in, self._clock.now())

    async def drive(self, driver: TruckClient, work: Path, show: Callable[[RosValues], None]) -> tuple[Reason, str]:
        """Send the path and wait for its end."""
        report = _FeedbackReport(self._feedback, show)
        # 10.0: default time without progress after which Nav2's controller server aborts (s)
        arrival = await follow(driver, self._clock, work, arm=False, report=report, disarmed_for=10.0)
        return arrival.reason, arrival.text

    def _feedback(self) -> RosValues:
        tracker, odometry = self._tracker.latest, self._odometry.latest
        if tracker is None or odometry is None:
            return {}
        speed, left = odometry.twist.vx, max(tracker.length - tracker.along, 0.0)
        followed = {
            "header": self._names().header(tracker),
            "position_tracking_error": tracker.cross_track,
            "heading_tracking_error": tracker.heading_error,
            "robot_pose": {"header": self._names().header(odometry), "pose": convert.pose_of(odometry.pose)},
            "distance_to_goal": left,
            "speed": speed,
            "remaining_path_length": left,
        }
        return {"distance_to_goal": left, "speed": speed, "tracking_feedback": followed}


class _FeedbackReport(DriveReport):
    """Feedback while a path is driven."""

    def __init__(self, values: Callable[[], RosValues], show: Callable[[RosValues], None]) -> None:
        self._values, self._show = values, show

    def under_way(self, what: str, share: float) -> None:
        """Publish feedback."""
        self._show(self._values())


class LifecycleCommand(IntEnum):
    """``command`` of ``nav2_msgs/srv/ManageLifecycleNodes``."""

    STARTUP = 0
    PAUSE = 1
    RESUME = 2
    RESET = 3
    SHUTDOWN = 4
    CONFIGURE = 5
    CLEANUP = 6

    @property
    def activates(self) -> bool:
        """Whether navigation is active after the command."""
        return self in (LifecycleCommand.STARTUP, LifecycleCommand.RESUME, LifecycleCommand.CONFIGURE)


class Navigation:
    """All actions, and the two lifecycle managers for Nav2's panel.

    Pausing navigation cancels the goals of the actions and refuses new ones until it is resumed; operators outside ROS
    2 are not affected. Localisation cannot be paused.

    Args:
        node: node of ROS 2.
        operators: sessions of the nodes that send goals.
        client: follows the robot's state.
        pose_in: reads poses.
        names: returns the current conversion of stamps and frames.
        clock: time.
    """

    def __init__(
        self,
        node: RosNode,
        operators: Operators,
        client: TruckClient,
        pose_in: PoseReader,
        names: Callable[[], convert.RosNames],
        clock: Clock,
    ) -> None:
        self._operators = operators
        self._health = client.watch(HEALTH)
        self._paused = False
        arguments = client, pose_in, names, clock
        actions: tuple[RobotAction[Any], ...] = (
            NavigateToPose(*arguments),
            NavigateThroughPoses(*arguments),
            FollowPath(*arguments),
        )
        self._servers = [ActionServer(action, node, operators, lambda: not self._paused, clock) for action in actions]
        managed = {
            "lifecycle_manager_navigation": (self._navigation_active, self._manage_navigation),
            "lifecycle_manager_localization": (self._localisation_active, self._manage_localisation),
        }
        for name, (active, manage) in managed.items():
            node.serve(f"{name}/is_active", "std_srvs/srv/Trigger", active)
            node.serve(f"{name}/manage_nodes", "nav2_msgs/srv/ManageLifecycleNodes", manage)

    def close(self) -> None:
        """Cancel all goals."""
        for server in self._servers:
            server.close()

    def _ready(self, service: ServiceName) -> Mapping[str, Any]:
        table = self._health.latest
        rows = () if table is None else table.services
        state = next((row.state for row in rows if row.name == service), None)
        text = f"{service} is {'not there' if state is None else state}"
        return {"success": state is ServiceState.READY, "message": text}

    async def _navigation_active(self, _: RosMessage, __: RosSender | None) -> Mapping[str, Any]:
        if self._paused:
            return {"success": False, "message": "paused"}
        return self._ready(ServiceName.GOALS)

    async def _localisation_active(self, _: RosMessage, __: RosSender | None) -> Mapping[str, Any]:
        return self._ready(ServiceName.SLAM)

    async def _manage_navigation(self, request: RosMessage, sender: RosSender | None) -> Mapping[str, Any]:
        command = _command(request)
        if command is None or (command.activates and sender is None):
            return {"success": False}
        self._paused = not command.activates
        if self._paused:
            for server in self._servers:
                server.cancel_all()
            return {"success": True}
        return {"success": self._ready(ServiceName.GOALS)["success"]}

    async def _manage_localisation(self, request: RosMessage, _: RosSender | None) -> Mapping[str, Any]:
        command = _command(request)
        return {"success": command is not None and command.activates and self._ready(ServiceName.SLAM)["success"]}


def _command(request: RosMessage) -> LifecycleCommand | None:
    try:
        return LifecycleCommand(request["command"])
    except ValueError:
        return None
