"""Sends goals of ``navigate_to_pose`` with ``pyzeros``, with services and hashes of ``ros2_pyterfaces``.

    python -m benchmarks.ros2_parts.pyzeros_goals PORT

Waits for a line of JSON: two poses (x in m, y in m, yaw in rad) in map. The goal at the first one is reached, the one
at the second is cancelled, and a third far outside the map is refused. Prints a JSON object: status, text and number of
feedback messages of each.
"""

# mypy: disable-error-code="call-arg"
import asyncio
import json
import math
import sys
from dataclasses import dataclass, field
from typing import Any

import pyzeros
import zenoh
from pyzeros.sub import RawSub
from ros2_pyterfaces.cyclone import idl
from ros2_pyterfaces.cyclone.all_msgs import UUID, Duration, Header, Point, Pose, PoseStamped, Quaternion, Time
from ros2_pyterfaces.cyclone.service_msgs.msg import ServiceEventInfo

from benchmarks.ros2_parts.pyzeros_driver import session

TYPE = "nav2_msgs/action/NavigateToPose"
NAME = "/navigate_to_pose/_action"


# Interfaces as ``nav2_msgs`` of Jazzy has them; ``ros2_pyterfaces`` makes their hashes and bytes


@dataclass
class Goal(idl.IdlStruct, typename=f"{TYPE}_Goal"):
    """A pose to drive to."""

    pose: PoseStamped = field(default_factory=PoseStamped)
    behavior_tree: str = ""


@dataclass
class Result(idl.IdlStruct, typename=f"{TYPE}_Result"):
    """Reason of the failure."""

    error_code: idl.types.uint16 = 0
    error_msg: str = ""


@dataclass
class Feedback(idl.IdlStruct, typename=f"{TYPE}_Feedback"):
    """Progress."""

    current_pose: PoseStamped = field(default_factory=PoseStamped)
    navigation_time: Duration = field(default_factory=Duration)
    estimated_time_remaining: Duration = field(default_factory=Duration)
    number_of_recoveries: idl.types.int16 = 0
    distance_remaining: idl.types.float32 = 0.0


@dataclass
class FeedbackMessage(idl.IdlStruct, typename=f"{TYPE}_FeedbackMessage"):
    """Progress of a goal, with its id."""

    goal_id: UUID = field(default_factory=UUID)
    feedback: Feedback = field(default_factory=Feedback)


@dataclass
class SendGoalRequest(idl.IdlStruct, typename=f"{TYPE}_SendGoal_Request"):
    """Request of a goal."""

    goal_id: UUID = field(default_factory=UUID)
    goal: Goal = field(default_factory=Goal)


@dataclass
class SendGoalResponse(idl.IdlStruct, typename=f"{TYPE}_SendGoal_Response"):
    """Whether the goal is accepted."""

    accepted: bool = False
    stamp: Time = field(default_factory=Time)


@dataclass
class GetResultRequest(idl.IdlStruct, typename=f"{TYPE}_GetResult_Request"):
    """Request of a goal's result."""

    goal_id: UUID = field(default_factory=UUID)


@dataclass
class GetResultResponse(idl.IdlStruct, typename=f"{TYPE}_GetResult_Response"):
    """Result of a goal."""

    status: idl.types.int8 = 0
    result: Result = field(default_factory=Result)


@dataclass
class GoalInfo(idl.IdlStruct, typename="action_msgs/msg/GoalInfo"):
    """Identity of a goal."""

    goal_id: UUID = field(default_factory=UUID)
    stamp: Time = field(default_factory=Time)


@dataclass
class CancelRequest(idl.IdlStruct, typename="action_msgs/srv/CancelGoal_Request"):
    """Request to cancel a goal."""

    goal_info: GoalInfo = field(default_factory=GoalInfo)


@dataclass
class CancelResponse(idl.IdlStruct, typename="action_msgs/srv/CancelGoal_Response"):
    """Cancelled goals."""

    return_code: idl.types.int8 = 0
    goals_canceling: idl.types.sequence[GoalInfo] = field(default_factory=list)


def service(request: Any, response: Any) -> Any:
    """Return a service of two messages, with the event that is part of its hash."""
    name = request.get_type_name().removesuffix("_Request")

    @dataclass
    class Event(idl.IdlStruct, typename=f"{name}_Event"):
        info: ServiceEventInfo = field(default_factory=ServiceEventInfo)
        request: idl.types.sequence[request, 1] = field(default_factory=list)
        response: idl.types.sequence[response, 1] = field(default_factory=list)

    return idl.make_idl_service(request, response, _event_type=Event)


def stamped(x: float, y: float, yaw: float) -> PoseStamped:
    """A pose in map."""
    turn = Quaternion(x=0.0, y=0.0, z=math.sin(yaw / 2.0), w=math.cos(yaw / 2.0))
    return PoseStamped(header=Header(frame_id="map"), pose=Pose(position=Point(x=x, y=y, z=0.0), orientation=turn))


async def main(port: int) -> None:
    """Send all goals."""
    with pyzeros.auto_context(node="pyzeros_goals", zenoh_session=session(port, 120_000)):
        send = pyzeros.Client(service(SendGoalRequest, SendGoalResponse), f"{NAME}/send_goal")
        result = pyzeros.Client(service(GetResultRequest, GetResultResponse), f"{NAME}/get_result")
        cancel = pyzeros.Client(service(CancelRequest, CancelResponse), f"{NAME}/cancel_goal")
        feedbacks: list[float] = []

        def follow(sample: zenoh.Sample) -> None:
            feedbacks.append(FeedbackMessage.deserialize(sample.payload.to_bytes()).feedback.distance_remaining)

        listener = RawSub(FeedbackMessage, f"{NAME}/feedback", follow)
        print("ready", flush=True)
        near, far = json.loads(await asyncio.to_thread(sys.stdin.readline))
        found = {}
        rows = {"driven": (near, None), "cancelled": (far, 1.5), "refused": ((200.0, 200.0, 0.0), None)}
        for number, (name, (place, cancel_after)) in enumerate(rows.items()):
            uuid = UUID(uuid=bytes([number + 1]) * 16)
            feedbacks.clear()
            answer = await send.call_async(SendGoalRequest(goal_id=uuid, goal=Goal(pose=stamped(*place))))
            assert answer.accepted
            ended = asyncio.ensure_future(result.call_async(GetResultRequest(goal_id=uuid)))
            if cancel_after is not None:
                await asyncio.sleep(cancel_after)
                await cancel.call_async(CancelRequest(goal_info=GoalInfo(goal_id=uuid)))
            end = await ended
            found[name] = end.status, end.result.error_msg, len(feedbacks)
        listener.close()
    print(json.dumps(found), flush=True)


if __name__ == "__main__":
    asyncio.run(main(int(sys.argv[1])))
