"""The action ``navigate_to_pose`` of Nav2, driven by the robot's own planner.

Feedback goes out in two editions, for Lyrical has another hash of it than Jazzy and Kilted. A goal that the robot
refuses is accepted first and then aborted: only a result can say why.
"""

import asyncio
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, Final

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.drives import run_task
from monstertruck_runtime.errors import InputError, RequestRefusedError, TruckError
from monstertruck_schemas.plan import GoalState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import GoalOrder
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.topics import GOAL, POSE
from monstertruckd.ros2 import convert
from monstertruckd.ros2.cdr import RosMessage
from monstertruckd.ros2.node import RosNode, RosSender
from monstertruckd.ros2.operators import Operators, stamp_of
from monstertruckd.ros2.rmw import LATCHED, RELIABLE

NAME: Final = "navigate_to_pose"
ACTION: Final = "nav2_msgs/action/NavigateToPose"
KEPT: Final = 32
"""Goals whose result can still be asked for."""
FAILED: Final = 9000
"""``error_code`` of a goal that failed; ``error_msg`` says why."""

GoalPose = tuple[tuple[float, float, float], str]
"""x, y (m), yaw (rad), and the frame as the robot calls it."""


class GoalStatus(IntEnum):
    """``action_msgs/msg/GoalStatus``."""

    UNKNOWN = 0
    ACCEPTED = 1
    EXECUTING = 2
    CANCELING = 3
    SUCCEEDED = 4
    CANCELED = 5
    ABORTED = 6

    @property
    def ended(self) -> bool:
        """Whether it never changes again."""
        return self >= GoalStatus.SUCCEEDED


class CancelCode(IntEnum):
    """``return_code`` of ``action_msgs/srv/CancelGoal``."""

    NONE = 0
    REJECTED = 1
    UNKNOWN_GOAL = 2
    TERMINATED = 3


@dataclass(slots=True)
class ActionGoal:
    """One goal."""

    number: bytes
    """Its UUID."""
    stamp: int
    """When it was accepted, real time, ns."""
    status: GoalStatus = GoalStatus.ACCEPTED
    text: str = ""
    """Why it failed."""
    ended: asyncio.Event = field(default_factory=asyncio.Event)
    driver: TruckClient | None = None
    """Session of the node that sent it."""
    task: asyncio.Task[None] | None = None

    def result(self) -> Mapping[str, Any]:
        """``nav2_msgs/action/NavigateToPose_GetResult_Response``."""
        code = 0 if self.status is GoalStatus.SUCCEEDED else FAILED
        return {"status": int(self.status), "result": {"error_code": code, "error_msg": self.text}}


def chosen(goals: Mapping[bytes, ActionGoal], number: bytes, stamp: int) -> tuple[CancelCode, list[ActionGoal]]:
    """Goals that a request to cancel means: one, all until a time, or all.

    Args:
        goals: by UUID.
        number: zero = any.
        stamp: real time, ns; zero = any.
    """
    everything = not any(number)
    if not everything and stamp == 0:
        if number not in goals:
            return CancelCode.UNKNOWN_GOAL, []
        goal = goals[number]
        return (CancelCode.TERMINATED, []) if goal.status.ended else (CancelCode.NONE, [goal])
    found = [
        goal
        for goal in goals.values()
        if not goal.status.ended and (goal.number == number or goal.stamp <= stamp or (everything and stamp == 0))
    ]
    return (CancelCode.NONE if found else CancelCode.REJECTED), found


class NavigateToPose:
    """The action server.

    Args:
        node: of ROS 2.
        operators: sessions of the nodes that send goals.
        client: follows the robot's pose.
        pose_in: reads a ``geometry_msgs/msg/PoseStamped``; raises ``InputError`` for another frame.
        names: stamps and frames, as they are now.
        clock: time.
    """

    def __init__(
        self,
        node: RosNode,
        operators: Operators,
        client: TruckClient,
        pose_in: Callable[[RosMessage], GoalPose],
        names: Callable[[], convert.RosNames],
        clock: Clock,
    ) -> None:
        self._operators = operators
        self._pose_in = pose_in
        self._names = names
        self._clock = clock
        self._pose = client.watch(POSE)
        self._goals: dict[bytes, ActionGoal] = {}
        action = f"{NAME}/_action"
        self._feedback = [
            node.publisher(f"{action}/feedback", f"{ACTION}{edition}_FeedbackMessage", RELIABLE)
            for edition in ("", "@lyrical")
        ]
        self._statuses = node.publisher(f"{action}/status", "action_msgs/msg/GoalStatusArray", LATCHED)
        node.serve(f"{action}/send_goal", f"{ACTION}_SendGoal", self._send_goal)
        node.serve(f"{action}/cancel_goal", "action_msgs/srv/CancelGoal", self._cancel_goal)
        node.serve(f"{action}/get_result", f"{ACTION}_GetResult", self._get_result)

    def close(self) -> None:
        """Give up all goals."""
        for goal in self._goals.values():
            if goal.task is not None:
                goal.task.cancel()

    def _real_time(self) -> int:
        return self._clock.now() + self._clock.real_offset()

    async def _send_goal(self, request: RosMessage, sender: RosSender | None) -> Mapping[str, Any]:
        number, now = bytes(request["goal_id"]["uuid"]), self._real_time()
        stamp = convert.RosNames().time(now)
        refused = {"accepted": False, "stamp": stamp}
        if sender is None:
            self._operators.refuse("an unknown client", NAME, "the graph has no client with its identity")
            return refused
        try:
            if request["goal"]["behavior_tree"]:
                raise InputError("behavior_tree: expected none, the robot plans itself")
            pose, frame = self._pose_in(request["goal"]["pose"])
            if number in self._goals:
                raise InputError("its UUID is that of another goal")
        except InputError as error:
            self._operators.refuse(sender.node, NAME, str(error))
            return refused
        goal = self._goals[number] = ActionGoal(number, now)
        self._forget_oldest()
        self._publish_status()
        goal.task = asyncio.create_task(self._pursue(goal, sender, pose, frame))
        return {"accepted": True, "stamp": stamp}

    def _forget_oldest(self) -> None:
        ended = [number for number, goal in self._goals.items() if goal.status.ended]
        for number in ended[: max(len(self._goals) - KEPT, 0)]:
            del self._goals[number]

    async def _pursue(self, goal: ActionGoal, sender: RosSender, pose: tuple[float, float, float], frame: str) -> None:
        status, text = GoalStatus.ABORTED, "given up"
        try:
            driver = goal.driver = await self._operators.session(sender)
            self._change(goal, GoalStatus.EXECUTING)
            end = await run_task(
                driver,
                GOAL,
                ServiceName.GOALS,
                lambda: driver.goal(pose, frame),
                lambda: driver.goal_control(GoalOrder.CANCEL, own=True),
                lambda state: self._publish_feedback(goal, state),
                arm=False,
                waits=True,
                clock=self._clock,
            )
            text = f"{end.reason.value}: {end.text or end.reason.text}"
            if end.reason is Reason.GOAL_REACHED:
                status, text = GoalStatus.SUCCEEDED, ""
            elif end.reason is Reason.CANCELLED and goal.status is GoalStatus.CANCELING:
                status = GoalStatus.CANCELED
        except TruckError as error:
            reason = error.refusal if isinstance(error, RequestRefusedError) else error.reason
            text = f"{reason.value}: {error}"
            self._operators.refuse(sender.node, NAME, text)
        finally:
            goal.text = text
            self._change(goal, status)
            goal.ended.set()

    def _change(self, goal: ActionGoal, status: GoalStatus) -> None:
        goal.status = status
        self._publish_status()

    def _publish_status(self) -> None:
        rows = [{"goal_info": self._info(goal), "status": int(goal.status)} for goal in self._goals.values()]
        self._statuses({"status_list": rows})

    @staticmethod
    def _info(goal: ActionGoal) -> dict[str, Any]:
        return {"goal_id": {"uuid": goal.number}, "stamp": convert.RosNames().time(goal.stamp)}

    def _publish_feedback(self, goal: ActionGoal, state: GoalState) -> None:
        pose, names = self._pose.latest, self._names()
        seconds, rest = divmod(state.elapsed, 1.0)
        values: dict[str, Any] = {
            "navigation_time": {"sec": int(seconds), "nanosec": int(rest * SECOND)},
            "number_of_recoveries": state.recoveries,
            "distance_remaining": state.remaining,
        }
        if pose is not None:
            values["current_pose"] = {"header": names.header(pose), "pose": convert.pose_of(pose.pose)}
        for publish in self._feedback:
            publish({"goal_id": {"uuid": goal.number}, "feedback": values})

    async def _cancel_goal(self, request: RosMessage, _: RosSender | None) -> Mapping[str, Any]:
        info = request["goal_info"]
        code, goals = chosen(self._goals, bytes(info["goal_id"]["uuid"]), stamp_of(info["stamp"]))
        for goal in goals:
            self._change(goal, GoalStatus.CANCELING)
            if goal.driver is not None:
                try:
                    await goal.driver.goal_control(GoalOrder.CANCEL, own=True)
                except TruckError as error:
                    self._operators.refuse("a client", f"{NAME}, cancel", str(error))
        return {"return_code": int(code), "goals_canceling": [self._info(goal) for goal in goals]}

    async def _get_result(self, request: RosMessage, _: RosSender | None) -> Mapping[str, Any]:
        goal = self._goals.get(bytes(request["goal_id"]["uuid"]))
        if goal is None:
            return {"status": int(GoalStatus.UNKNOWN)}
        await goal.ended.wait()
        return goal.result()
