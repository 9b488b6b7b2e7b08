"""ROS 2 action servers for the robot's tasks, for any action type.

An action has one edition for each set of fields among the distributions. The node serves all editions of its
distributions at once: editions with different hashes are different services and topics on the wire. A goal that the
robot refuses is accepted and then aborted, because only a result can carry the reason.
"""

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from functools import partial
from typing import Any, ClassVar, Final, Generic, TypeVar

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import InputError, RequestRefusedError, TruckError
from monstertruck_schemas.reasons import Reason
from monstertruckd.ros2 import convert
from monstertruckd.ros2.cdr import RosMessage
from monstertruckd.ros2.convert import RosValues
from monstertruckd.ros2.interfaces import action_edition, interfaces, type_hash
from monstertruckd.ros2.node import RosNode, RosSender
from monstertruckd.ros2.operators import Operators, stamp_of
from monstertruckd.ros2.rmw import LATCHED, RELIABLE

FAILED: Final = 9000
"""``error_code`` of a failed goal; ``error_msg`` contains the reason."""

W = TypeVar("W")


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
        """Whether the status is final."""
        return self >= GoalStatus.SUCCEEDED


class CancelCode(IntEnum):
    """``return_code`` of ``action_msgs/srv/CancelGoal``."""

    NONE = 0
    REJECTED = 1
    UNKNOWN_GOAL = 2
    TERMINATED = 3


@dataclass(slots=True)
class ActionGoal(Generic[W]):
    """One goal."""

    number: bytes
    """UUID of the goal."""
    stamp: int
    """Real time of acceptance (ns)."""
    work: W
    """Goal as the robot executes it."""
    status: GoalStatus = GoalStatus.ACCEPTED
    text: str = ""
    """Reason of the failure."""
    ended: asyncio.Event = field(default_factory=asyncio.Event)
    task: asyncio.Task[None] | None = None


class RobotAction(ABC, Generic[W]):
    """Executes the goals of one action; ``W`` is the robot's type of a goal."""

    name: ClassVar[str]
    interface: ClassVar[str]

    @abstractmethod
    def read(self, goal: RosMessage) -> W:
        """Return the converted goal.

        Raises:
            InputError: the goal is invalid or ambiguous for the robot.
        """

    @abstractmethod
    async def drive(self, driver: TruckClient, work: W, show: Callable[[RosValues], None]) -> tuple[Reason, str]:
        """Execute a goal; return the outcome and its text. Cancellation stops the robot's task.

        Args:
            driver: session of the node that sent the goal.
            work: result of ``read``.
            show: publishes feedback, with the fields of all editions.

        Raises:
            TruckError: the robot refuses or does not answer.
        """

    def result(self, work: W, status: GoalStatus) -> RosValues:
        """Return the fields of the result other than ``error_code`` and ``error_msg``."""
        return {}


def within(interface: str, values: Mapping[str, Any]) -> RosValues:
    """Return the values of the fields that an edition has."""
    names = {own.name for own in interfaces()[interface]}
    return {name: value for name, value in values.items() if name in names}


def chosen(goals: Mapping[bytes, ActionGoal[W]], number: bytes, stamp: int) -> tuple[CancelCode, list[ActionGoal[W]]]:
    """Return the goals that a cancel request selects: one, all accepted until a time, or all.

    Args:
        goals: goals by UUID.
        number: zero = any.
        stamp: real time (ns); zero = any.
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


class ActionServer(Generic[W]):
    """Serves one action.

    Args:
        action: execution of its goals.
        node: node of ROS 2.
        operators: sessions of the nodes that send goals.
        active: returns whether goals are currently accepted.
        clock: time.
    """

    def __init__(
        self, action: RobotAction[W], node: RosNode, operators: Operators, active: Callable[[], bool], clock: Clock
    ) -> None:
        self._action = action
        self._operators = operators
        self._active = active
        self._clock = clock
        self._goals: dict[bytes, ActionGoal[W]] = {}
        place = f"{action.name}/_action"
        editions = [action_edition(action.interface, name) for name in node.distributions]
        self._feedback = [
            (f"{edition}_Feedback", node.publisher(f"{place}/feedback", f"{edition}_FeedbackMessage", RELIABLE))
            for edition in _distinct(editions, "_FeedbackMessage")
        ]
        self._statuses = node.publisher(f"{place}/status", "action_msgs/msg/GoalStatusArray", LATCHED)
        node.serve(f"{place}/cancel_goal", "action_msgs/srv/CancelGoal", self._cancel_goal)
        for edition in _distinct(editions, "_SendGoal"):
            node.serve(f"{place}/send_goal", f"{edition}_SendGoal", self._send_goal)
        for edition in _distinct(editions, "_GetResult"):
            answer = partial(self._get_result, f"{edition}_Result")
            node.serve(f"{place}/get_result", f"{edition}_GetResult", answer)

    def close(self) -> None:
        """Cancel all goals."""
        for goal in self._goals.values():
            if goal.task is not None:
                goal.task.cancel()

    def cancel_all(self) -> None:
        """Cancel all goals as a client does."""
        self._cancel(goal for goal in self._goals.values() if not goal.status.ended)

    def _real_time(self) -> int:
        return self._clock.now() + self._clock.real_offset()

    async def _send_goal(self, request: RosMessage, sender: RosSender | None) -> Mapping[str, Any]:
        number, now = bytes(request["goal_id"]["uuid"]), self._real_time()
        stamp = convert.RosNames().time(now)
        refused = {"accepted": False, "stamp": stamp}
        name = self._action.name
        if sender is None:
            self._operators.refuse("an unknown client", name, "the graph has no client with its identity")
            return refused
        try:
            if not self._active():
                raise InputError("navigation is paused: resume it with lifecycle_manager_navigation")
            work = self._action.read(request["goal"])
            if number in self._goals:
                raise InputError("its UUID belongs to another goal")
        except InputError as error:
            self._operators.refuse(sender.node, name, str(error))
            return refused
        goal = self._goals[number] = ActionGoal(number, now, work)
        self._forget_oldest()
        self._publish_status()
        goal.task = asyncio.create_task(self._pursue(goal, sender))
        return {"accepted": True, "stamp": stamp}

    def _forget_oldest(self) -> None:
        ended = [number for number, goal in self._goals.items() if goal.status.ended]
        for number in ended[: max(len(self._goals) - 32, 0)]:  # number of goals whose result can still be requested
            del self._goals[number]

    async def _pursue(self, goal: ActionGoal[W], sender: RosSender) -> None:
        status, text = GoalStatus.ABORTED, "given up"
        try:
            driver = await self._operators.session(sender)
            self._change(goal, GoalStatus.EXECUTING)
            reason, words = await self._action.drive(driver, goal.work, partial(self._show, goal))
            text = f"{reason.value}: {words or reason.text}"
            if reason is Reason.GOAL_REACHED:
                status, text = GoalStatus.SUCCEEDED, ""
            elif reason is Reason.CANCELLED and goal.status is GoalStatus.CANCELING:
                status = GoalStatus.CANCELED
        except TruckError as error:
            reason = error.refusal if isinstance(error, RequestRefusedError) else error.reason
            text = f"{reason.value}: {error}"
            self._operators.refuse(sender.node, self._action.name, text)
        except asyncio.CancelledError:
            if goal.status is not GoalStatus.CANCELING:
                raise
            status, text = GoalStatus.CANCELED, f"{Reason.CANCELLED.value}: {Reason.CANCELLED.text}"
        finally:
            goal.text = text
            self._change(goal, status)
            goal.ended.set()

    def _change(self, goal: ActionGoal[W], status: GoalStatus) -> None:
        goal.status = status
        self._publish_status()

    def _publish_status(self) -> None:
        rows = [{"goal_info": self._info(goal), "status": int(goal.status)} for goal in self._goals.values()]
        self._statuses({"status_list": rows})

    @staticmethod
    def _info(goal: ActionGoal[W]) -> RosValues:
        return {"goal_id": {"uuid": goal.number}, "stamp": convert.RosNames().time(goal.stamp)}

    def _show(self, goal: ActionGoal[W], values: RosValues) -> None:
        for interface, publish in self._feedback:
            publish({"goal_id": {"uuid": goal.number}, "feedback": within(interface, values)})

    def _cancel(self, goals: Iterable[ActionGoal[W]]) -> None:
        for goal in goals:
            if goal.task is not None and goal.status is not GoalStatus.CANCELING:
                self._change(goal, GoalStatus.CANCELING)
                goal.task.cancel()

    async def _cancel_goal(self, request: RosMessage, _: RosSender | None) -> Mapping[str, Any]:
        info = request["goal_info"]
        code, goals = chosen(self._goals, bytes(info["goal_id"]["uuid"]), stamp_of(info["stamp"]))
        self._cancel(goals)
        return {"return_code": int(code), "goals_canceling": [self._info(goal) for goal in goals]}

    async def _get_result(self, interface: str, request: RosMessage, _: RosSender | None) -> Mapping[str, Any]:
        goal = self._goals.get(bytes(request["goal_id"]["uuid"]))
        if goal is None:
            return {"status": int(GoalStatus.UNKNOWN)}
        await goal.ended.wait()
        code = 0 if goal.status is GoalStatus.SUCCEEDED else FAILED
        values = {"error_code": code, "error_msg": goal.text} | self._action.result(goal.work, goal.status)
        return {"status": int(goal.status), "result": within(interface, values)}


def _distinct(editions: Iterable[str], part: str) -> Iterable[str]:
    """Return the editions that differ on the wire."""
    found: dict[str, str] = {}
    for edition in editions:
        found.setdefault(type_hash(f"{edition}{part}"), edition)
    return found.values()
