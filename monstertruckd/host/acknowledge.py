"""Remote call ``acknowledge``: an operator says that a warning was seen, and it is an event in the log."""

from typing import Any, Final

from monstertruck_runtime.errors import InputError
from monstertruck_runtime.ports import EventSink
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruckd.bus.rpc import Rpc

ACKNOWLEDGE: Final = "acknowledge"
LONGEST: Final = 200
"""Characters of a warning."""


def register(rpc: Rpc, events: EventSink) -> None:
    """Serve ``acknowledge``; the payload is the ``text`` of the warning."""

    async def acknowledge(payload: dict[str, Any]) -> dict[str, Any]:
        text, by = payload.get("text"), str(payload.get("source", ""))
        if not isinstance(text, str) or not text or len(text) > LONGEST or not text.isprintable():
            raise InputError(f"text: expected 1 to {LONGEST} printable characters")
        events(Reason.ACKNOWLEDGED, Severity.INFO, "operator", f"{by} has seen: {text}", by=by)
        return {}

    rpc.register(ACKNOWLEDGE, acknowledge)
