"""The real client of a robot, without a network: for commands on the virtual clock."""

import json
from typing import Any, Self

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import VirtualClock
from monstertruck_runtime.mailbox import Delivery, Mailbox
from monstertruck_schemas.topics import Topic
from monstertruckd.daemon import Daemon


class LocalClient(TruckClient):
    """Calls and requests reach the daemon in this process directly; everything else is the client's own code."""

    def __init__(self, daemon: Daemon, clock: VirtualClock, source: str = "ann") -> None:
        super().__init__(daemon.config.robot, source=source, clock=clock)
        self._daemon = daemon

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        pass

    def subscribe(self, topic: Topic[Any], delivery: Delivery) -> Mailbox[Any]:
        return self._daemon.bus.subscribe(topic, delivery)

    async def get_retained(self, topic: Topic[Any]) -> Any:
        return self._daemon.bus.newest(topic)

    async def alive(self) -> bool:
        return True

    async def call(
        self, rpc: str, payload: dict[str, Any] | None = None, timeout: float | None = None
    ) -> dict[str, Any]:
        return await self._daemon.rpc.call(rpc, payload or {})

    async def _call(self, rpc: str, payload: dict[str, Any], timeout: float | None) -> bytes:
        return json.dumps(await self._daemon.rpc.call(rpc, payload)).encode()

    def _put(self, topic: Topic[Any], message: Any, key: Any = None) -> None:
        self._daemon.bus.inject(topic, message)
