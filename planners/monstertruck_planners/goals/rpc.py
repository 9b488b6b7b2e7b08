"""Goals by remote call: unlike a request by topic, a call is answered."""

import json
from typing import Any, Final, TypeVar

from pydantic import ValidationError

from monstertruck_planners.goals.service import GoalService
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import InputError, RequestRefusedError
from monstertruck_runtime.ports import RpcRegistry
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import GoalControl, GoalRequest, Request

GOAL: Final = "goal"
CONTROL: Final = "goal_control"
PATIENCE: Final = 4.0
"""Seconds to wait for the first route; the goal is pursued further."""

R = TypeVar("R", bound=Request)


def register(rpc: RpcRegistry, service: GoalService, clock: Clock) -> None:
    """Serve ``goal`` and ``goal_control``; their payloads are a ``GoalRequest`` and a ``GoalControl``.

    Args:
        rpc: where.
        service: what pursues goals.
        clock: time.
    """

    async def goal(payload: dict[str, Any]) -> dict[str, Any]:
        number = service.take(_request(GoalRequest, payload))
        try:
            async with clock.deadline(PATIENCE):
                state = await service.settled(number)
        except TimeoutError:
            return {"number": number, "planned": False}
        return {"number": number, "planned": True, "length": state.remaining}

    async def control(payload: dict[str, Any]) -> dict[str, Any]:
        service.control(_request(GoalControl, payload))
        return {}

    rpc.register(GOAL, goal)
    rpc.register(CONTROL, control)


def _request(model: type[R], payload: dict[str, Any]) -> R:
    """A request from outside.

    Raises:
        RequestRefusedError: a number is not finite.
        InputError: it is none.
    """
    try:
        return model.model_validate_json(json.dumps(payload))
    except ValidationError as error:
        detail = error.errors(include_url=False)[0]
        text = f"{'.'.join(map(str, detail['loc']))}: {detail['msg']}"
        if detail["type"] == "finite_number":
            raise RequestRefusedError(Reason.NOT_FINITE, text) from None
        raise InputError(text) from None
