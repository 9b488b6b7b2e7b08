"""Settings that can be changed while the robot runs, and their remote calls ``settings`` and ``set``.

A setting is live if its model marks it (``monstertruck_schemas.base.LIVE``). After every change the complete
configuration is validated as at the start, so that no value exceeds the limits of the body.
"""

import asyncio
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any, Final, TypeVar

from pydantic import ValidationError

from monstertruck_runtime.errors import InputError
from monstertruck_runtime.ports import EventSink
from monstertruck_runtime.threads import Offload
from monstertruck_schemas.base import LiveValue, first_mistake, live_settings
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import AccessRole
from monstertruckd.bus.rpc import Rpc
from monstertruckd.config.load import SavedSettings, put_settings
from monstertruckd.config.truck import TruckConfig

T = TypeVar("T", bound=TruckConfig)

LIST: Final = "settings"
SET: Final = "set"


def with_settings(config: T, values: Mapping[str, Any]) -> T:
    """Return ``config`` with new values for live settings, validated as a unit.

    Raises:
        InputError: a setting is unknown or not live, or a value is invalid; the message lists the possible values.
    """
    known = {setting.key for setting in live_settings(config)}
    data = config.model_dump()
    for key in values:
        if key not in known:
            raise InputError(
                f"{key}: cannot be changed while the robot runs; expected one of {', '.join(sorted(known))}"
            )
    put_settings(data, values)
    try:
        return type(config).model_validate(data)
    except ValidationError as error:
        raise InputError(first_mistake(error)) from error


class LiveConfig:
    """The running configuration, with replaceable live settings.

    Args:
        config: configuration at the daemon's start.
        apply: applies the settings to every component, between two ticks of the gate.
        events: receives events, one for every change, with its author.
        offload: runs validation and file writes.
    """

    def __init__(
        self, config: TruckConfig, apply: Callable[[TruckConfig], None], events: EventSink, offload: Offload
    ) -> None:
        self.config = config
        self._began = {setting.key: setting.value for setting in live_settings(config)}
        self._apply = apply
        self._events = events
        self._offload = offload
        self._saved = SavedSettings(config.state_directory, config.robot)
        self._start = config
        self._kept: dict[str, LiveValue] = {}
        """Settings saved in this run."""
        self._turn = asyncio.Lock()

    def register(self, rpc: Rpc) -> None:
        """Serve ``settings`` and ``set``."""
        rpc.register(LIST, self._list, AccessRole.OBSERVER, recorded=False)
        rpc.register(SET, self._set, AccessRole.ENGINEER)

    async def _list(self, _: dict[str, Any]) -> dict[str, Any]:
        rows = [asdict(setting) | {"began": self._began[setting.key]} for setting in live_settings(self.config)]
        return {"settings": rows, "file": str(self._saved.path)}

    async def _set(self, payload: dict[str, Any]) -> dict[str, Any]:
        values, save, by = _values(payload.get("values")), payload.get("save", False), str(payload.get("source", ""))
        if not isinstance(save, bool):
            raise InputError(f"save: expected true or false, got {save!r}")
        async with self._turn:
            changed = await self._offload(lambda: with_settings(self.config, values))
            if save:
                await self._offload(lambda: self._keep(values))
            before = {setting.key: setting.value for setting in live_settings(self.config)}
            weaker = [text for text in changed.weakened() if text not in self.config.weakened()]
            self.config = changed
            self._apply(changed)
        for key, value in values.items():
            text = f"{key}: {before[key]} to {value} by {by}{', saved' if save else ''}"
            self._events(
                Reason.SETTING_CHANGED, Severity.INFO, "settings", text, key=key, value=value, by=by, saved=save
            )
        return {"values": values, "file": str(self._saved.path) if save else None, "weakened": weaker}

    def _keep(self, values: dict[str, LiveValue]) -> None:
        """Save settings, unless the next start would reject them without the unsaved ones."""
        kept = self._kept | values
        with_settings(self._start, kept)
        self._saved.save(values)
        self._kept = kept


def _values(given: Any) -> dict[str, LiveValue]:
    """Parse the settings in a request.

    Raises:
        InputError: the request contains no settings or too many; the models check the values.
    """
    most = 32  # maximum number of settings changed by one call
    if not isinstance(given, dict) or not 0 < len(given) <= most:
        raise InputError(f"values: expected 1 to {most} settings by their dotted names")
    for key, value in given.items():
        if not isinstance(value, float | int | bool | str):
            raise InputError(f"{key}: expected a plain value, got {type(value).__name__}")
    return given
