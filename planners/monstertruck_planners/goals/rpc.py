"""Goals by remote call: unlike a request by topic, a call is answered."""

from typing import Any, Final

from monstertruck_planners.goals.service import GoalService
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.ports import RpcRegistry
from monstertruck_runtime.requests import parse_request
from monstertruck_schemas.req import GoalControl, GoalRequest

GOAL: Final = "goal"
CONTROL: Final = "goal_control"
PATIENCE: Final = 4.0
"""Seconds to wait for the first route; the goal is pursued further."""


def register(rpc: RpcRegistry, service: GoalService, clock: Clock) -> None:
    """Serve ``goal`` and ``goal_control``; their payloads are a ``GoalRequest`` and a ``GoalControl``.

    Args:
        rpc: where.
        service: what pursues goals.
        clock: time.
    """

    async def goal(payload: dict[str, Any]) -> dict[str, Any]:
        number = service.take(parse_request(GoalRequest, payload))
        try:
            async with clock.deadline(PATIENCE):
                state = await service.settled(number)
        except TimeoutError:
            return {"number": number, "planned": False}
        return {"number": number, "planned": True, "length": state.remaining}

    async def control(payload: dict[str, Any]) -> dict[str, Any]:
        service.control(parse_request(GoalControl, payload))
        return {}

    rpc.register(GOAL, goal)
    rpc.register(CONTROL, control)
