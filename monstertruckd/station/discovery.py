"""Discovery of robots by their liveliness tokens, at a robot or a Zenoh router."""

import asyncio
import json
import logging
from collections.abc import Callable
from typing import Final

import zenoh
from zenoh import handlers

from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import InputError, NotFoundError, TruckError
from monstertruck_runtime.stations import require_certificates, session_config, tls_for
from monstertruck_runtime.threads import ThreadHop, in_thread
from monstertruck_schemas.topics import KEY_ROOT, alive_key
from monstertruckd.station.address import RobotAddress

log = logging.getLogger(__name__)

MOST_ROBOTS: Final = 64
"""Maximum number of robots added by one router; a page cannot show more of them sensibly."""


class Discovery:
    """Watches one endpoint for robots; if the endpoint is absent, waits for it.

    Args:
        endpoint: endpoint of a Zenoh router or a robot.
        clock: clock of the station.
        found: called on the event loop, once for every robot that appears.
    """

    def __init__(self, endpoint: str, clock: Clock, found: Callable[[RobotAddress], object]) -> None:
        self._endpoint = endpoint
        self._clock = clock
        self._found = found
        self._known: set[str] = set()
        self._retry = 1.0  # time between connection attempts to a router, and timeout of each (s)

    async def run(self) -> None:
        """Watch until cancelled; log the reason for a failed connection once."""
        said = ""
        while True:
            try:
                session = await in_thread(self._open)
            except TruckError as error:
                if str(error) != said:
                    said = str(error)
                    log.warning("no robots from %s: %s", self._endpoint, said)
                await self._clock.sleep(self._retry)
                continue
            await self._watch(session)

    def _open(self) -> zenoh.Session:
        tls = tls_for(self._endpoint)
        config = session_config(self._endpoint, self._retry, tls)
        try:
            return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
        except zenoh.ZError as error:
            require_certificates(self._endpoint, tls)
            raise NotFoundError(f"nothing answers at {self._endpoint} within {self._retry} s") from error

    async def _watch(self, session: zenoh.Session) -> None:
        hop: ThreadHop[str] = ThreadHop(self._take, 4 * MOST_ROBOTS, lambda _: None)

        def receive(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.PUT:
                hop.put(str(sample.key_expr))

        try:
            session.liveliness().declare_subscriber(alive_key("*"), handlers.Callback(receive), history=True)
            await asyncio.Event().wait()
        finally:
            hop.close()
            await in_thread(session.close)

    def _take(self, key: str) -> None:
        name = key.removeprefix(f"{KEY_ROOT}/").partition("/")[0]
        if name in self._known or len(self._known) >= MOST_ROBOTS:
            return
        try:
            address = RobotAddress.parse(f"{name}@{self._endpoint}")
        except InputError as error:
            log.warning("robot skipped: %s", error)
            return
        self._known.add(name)
        self._found(address)
