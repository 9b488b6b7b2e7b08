"""Calibration calls of the daemon, the only writer of the calibration."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from pydantic import ValidationError

from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import InputError, RequestRefusedError
from monstertruck_runtime.ports import EventSink
from monstertruck_runtime.threads import Offload
from monstertruck_schemas.base import first_mistake
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.state import GateMode
from monstertruckd.bus.rpc import Rpc
from monstertruckd.config.calibration import CalibrationStore, Result, unused, with_values
from monstertruckd.config.expiry import CalibrationWatch
from monstertruckd.config.proposal import WIZARD as STEERING_WIZARD
from monstertruckd.config.truck import TruckConfig
from monstertruckd.config.wizards import WIZARDS

SHOW: Final = "calibration"
SAVE: Final = "calibration_save"
UNDO: Final = "calibration_undo"


def register(
    rpc: Rpc,
    config: TruckConfig,
    loaded: Path | None,
    clock: Clock,
    events: EventSink,
    offload: Offload,
    mode: Callable[[], GateMode],
    watch: CalibrationWatch,
) -> None:
    """Serve ``calibration``, ``calibration_save`` and ``calibration_undo``.

    Args:
        rpc: registry of remote calls.
        config: running configuration, including the calibration.
        loaded: calibration file in use.
        clock: clock for the dates of files.
        events: receives events, one for every new file.
        offload: runs file reads and writes.
        mode: returns the gate's current mode; files are written only while the truck is disarmed.
        watch: adds grades and expiry to results, and holds the proposal.
    """
    store = CalibrationStore(config.calibration_folder, config.robot)

    def real_time() -> int:
        return clock.now() + clock.real_offset()

    def announced(path: Path, what: str, by: Any) -> dict[str, Any]:
        events(
            Reason.OK,
            Severity.INFO,
            "calibration",
            f"{path}: {what}; the daemon applies it at its next start",
            by=str(by),
        )
        return {"file": str(path)}

    def at_rest() -> None:
        if mode().active:
            raise RequestRefusedError(Reason.BUSY, f"the robot is {mode()}: disarm it before saving a calibration")

    async def show(_: dict[str, Any]) -> dict[str, Any]:
        def read() -> dict[str, Any]:
            newest = store.newest()
            file = None if newest is None else store.load(newest)
            return {
                "folder": str(store.folder),
                "loaded": None if loaded is None else str(loaded),
                "newest": None if newest is None else str(newest),
                "content": None if file is None else file.model_dump(mode="json"),
                "unused": [] if file is None else unused(config, file.results.values()),
                "proposed": None if proposed is None else proposed.model_dump(mode="json"),
            }

        proposed = None if watch.proposal is None else watch.proposal.result
        return await offload(read)

    async def save(payload: dict[str, Any]) -> dict[str, Any]:
        at_rest()
        result = _result(payload.get("result"))
        await offload(lambda: with_values(config, [result], "result"))
        path = await offload(lambda: store.save(watch.stamped(result), real_time()))
        if result.wizard == STEERING_WIZARD:
            await watch.close_proposal()
        saved = (await offload(lambda: store.load(path))).results[result.wizard]
        answer = announced(path, f"{result.wizard} calibrated", payload.get("source"))
        return answer | {"result": saved.model_dump(mode="json")}

    async def undo(payload: dict[str, Any]) -> dict[str, Any]:
        wizard = payload.get("wizard")
        if not isinstance(wizard, str) or wizard not in WIZARDS:
            raise InputError(f"wizard: expected one of {', '.join(WIZARDS)}, got {wizard!r}")
        at_rest()
        path = await offload(lambda: store.undo(wizard, real_time()))
        if wizard == STEERING_WIZARD:
            await watch.close_proposal()
        return announced(path, f"calibration of {wizard} undone", payload.get("source"))

    rpc.register(SHOW, show, AccessRole.OBSERVER, recorded=False)
    rpc.register(SAVE, save, AccessRole.ENGINEER)
    rpc.register(UNDO, undo, AccessRole.ENGINEER)


def _result(payload: Any) -> Result:
    """Parse a result received from a client.

    Raises:
        InputError: the result is invalid.
    """
    try:
        return Result.model_validate_json(json.dumps(payload))
    except ValidationError as error:
        raise InputError(f"result: {first_mistake(error)}") from error
