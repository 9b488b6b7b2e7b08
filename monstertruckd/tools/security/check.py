"""Tests a running robot from outside: admitted clients, delivered and dropped messages.

Nothing moves: the order used to test delivery has no nonce, so the gate refuses it.
"""

import socket
import tempfile
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.endpoints import host_of, port_of, protocol_of
from monstertruck_runtime.errors import InputError, NoAnswerError, NotFoundError, RequestRefusedError, TruckError
from monstertruck_runtime.mailbox import latest
from monstertruck_runtime.stations import ClientTls, link_refusal
from monstertruck_runtime.threads import in_thread
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.topics import GATE
from monstertruckd.tools.security.certificates import Certificate, issue, new_authority
from monstertruckd.tools.security.folder import Folder

ABSENCE_TIMEOUT: Final = 1.5
"""Seconds to wait for what may not come."""
LONG_LIFE: Final = 600


@dataclass(frozen=True, slots=True)
class Case:
    """One attempt and its result."""

    who: str
    expected: str
    found: str
    met: bool


async def check(folder: Folder, endpoint: str, clock: Clock) -> list[Case]:
    """Run all attempts at ``endpoint``.

    Args:
        folder: folder of the authority, which issues temporary certificates for the test.
        endpoint: endpoint of the robot, ``tls/...``.
        clock: source of time.

    Raises:
        InputError: no TLS endpoint, or the folder has no pilot and no engineer.
        NotFoundError: no process listens there, or there is no authority.
    """
    if protocol_of(endpoint) != "tls":
        raise InputError(f"{endpoint}: expected a tls/HOST:PORT endpoint")
    with tempfile.TemporaryDirectory() as scratch:
        attempt = _Attempt(folder, endpoint, clock, Path(scratch))
        await attempt.reachable()
        return [case async for case in attempt.cases()]


class _Attempt:
    """The cases at one endpoint.

    Args:
        folder: folder of the authority.
        endpoint: endpoint of the robot.
        clock: source of time.
        scratch: folder for certificates.
    """

    def __init__(self, folder: Folder, endpoint: str, clock: Clock, scratch: Path) -> None:
        self._folder, self._endpoint, self._clock, self._scratch = folder, endpoint, clock, scratch
        self._register = folder.register()
        self._ca = folder.path / "authority.pem"

    async def reachable(self) -> None:
        """Raise NotFoundError if no process listens there."""
        place = host_of(self._endpoint), port_of(self._endpoint) or 0
        try:
            (await in_thread(lambda: socket.create_connection(place, ABSENCE_TIMEOUT))).close()
        except OSError as error:
            raise NotFoundError(f"no server at {self._endpoint}: {error}") from None

    async def cases(self) -> AsyncIterator[Case]:
        """Run all cases in turn."""
        drivers = self._register.of_role(AccessRole.PILOT, AccessRole.ENGINEER)
        if not drivers:
            raise InputError("no pilot or engineer is certified: monstertruckd security add NAME --role pilot")
        pilot, observers = drivers[0], self._register.of_role(AccessRole.OBSERVER)
        yield await self._case(f"{pilot}, a pilot", "state, calls and orders", pilot, self._may_all)
        if observers:
            yield await self._case(f"{observers[0]}, an observer", "state, no orders", observers[0], self._may_see)
        yield await self._case(f"{pilot} under another name", "no request arrives", pilot, self._not_as_another)
        authority, now = self._folder.authority(), self._now()
        stranger = issue(authority, "stranger", now, LONG_LIFE)
        yield await self._refused("a stranger of this authority", stranger, "no link, or an empty view")
        rogue = issue(new_authority(authority.certificate.subject.rfc4514_string()[3:], now, 1), pilot, now, LONG_LIFE)
        yield await self._refused(f"{pilot} of another authority", rogue, "no link")
        yield await self._refused("no certificate", None, "no link")
        yield await self._plain()
        yield await self._expiring(pilot)

    # Cases

    async def _case(self, who: str, expected: str, name: str, attempt: Callable[[TruckClient], Awaitable[str]]) -> Case:
        tls = self._files(self._made(name, LONG_LIFE), self._folder.issuer(name).pem)
        try:
            async with self._client(tls) as client:
                problem = await attempt(client)
        except TruckError as error:
            said = await in_thread(lambda: self._handshake(tls))
            problem = f"{error} ({said})" if said else str(error)
        return Case(who, expected, problem or expected, met=not problem)

    async def _refused(self, who: str, certificate: Certificate | None, expected: str) -> Case:
        tls = None if certificate is None else self._files(certificate)
        said = await in_thread(lambda: self._handshake(tls))
        if said:
            return Case(who, expected, f"no link: {said}", met=True)
        if tls is None:
            return Case(who, expected, "the link opens", met=False)
        try:
            async with self._client(tls) as client:
                seen = await client.alive() or await _arrives(client.call("versions"))
        except NotFoundError:
            return Case(who, expected, "no link", met=True)
        met = not seen and expected != "no link"
        return Case(who, expected, "sees the robot" if seen else "the link opens, no data visible", met=met)

    async def _plain(self) -> Case:
        plain = self._endpoint.replace("tls/", "tcp/", 1)
        try:
            async with TruckClient(self._register.robot, plain, clock=self._clock, timeout=ABSENCE_TIMEOUT):
                return Case("without TLS", "no link", "the link opens", met=False)
        except NotFoundError:
            return Case("without TLS", "no link", "no link", met=True)

    async def _expiring(self, name: str) -> Case:
        who, expected = "a certificate that expires", "state until then, no data afterwards"
        short = 6  # lifetime of the certificate in the expiry case, s
        tls = self._files(self._made(name, short), self._folder.issuer(name).pem)
        try:
            async with self._client(tls) as client:
                gate = client.subscribe(GATE, latest())
                first = await gate.next_within(ABSENCE_TIMEOUT)
                await self._clock.sleep(short)
                gate.drain()
                later = await gate.next_within(ABSENCE_TIMEOUT)
        except TruckError as error:
            return Case(who, expected, str(error), met=False)
        found = expected if first is not None and later is None else "no state" if first is None else "still state"
        return Case(who, expected, found, met=found == expected)

    # Finding of a client; "" as expected

    async def _may_all(self, client: TruckClient) -> str:
        if (problem := await self._sees(client)) or not await _arrives(client.call("versions")):
            return problem or "calls are not answered"
        reason = await _refusal(client)
        return "" if reason is Reason.BAD_NONCE else f"an order without nonce: {_said(reason)}"

    async def _may_see(self, client: TruckClient) -> str:
        if problem := await self._sees(client):
            return problem
        reason = await _refusal(client)
        return "" if reason is Reason.NOT_PERMITTED else f"an order: {_said(reason)}"

    async def _not_as_another(self, client: TruckClient) -> str:
        client.source = "another"
        return "a call under another name is answered" if await _arrives(client.call("versions")) else ""

    async def _sees(self, client: TruckClient) -> str:
        if not await client.alive():
            return "the robot's liveliness token is not visible"
        return "" if await client.get_retained(GATE) is not None else "the gate state is not visible"

    # Certificates and links

    def _now(self) -> int:
        return (self._clock.now() + self._clock.real_offset()) // SECOND

    def _made(self, name: str, seconds: int) -> Certificate:
        return issue(self._folder.issuer(name), name, self._now(), seconds)

    def _files(self, certificate: Certificate, *chain: bytes) -> ClientTls:
        folder = Path(tempfile.mkdtemp(dir=self._scratch))
        certificate.save(folder / "station.pem", folder / "station.key", *chain)
        return ClientTls(ca=self._ca, certificate=folder / "station.pem", key=folder / "station.key")

    @asynccontextmanager
    async def _client(self, tls: ClientTls) -> AsyncIterator[TruckClient]:
        made = TruckClient(self._register.robot, self._endpoint, clock=self._clock, timeout=ABSENCE_TIMEOUT, tls=tls)
        async with made as client:
            yield client

    def _handshake(self, tls: ClientTls | None) -> str:
        """Return why a link is refused; "" if it is accepted."""
        try:
            return link_refusal(self._endpoint, self._ca, tls, ABSENCE_TIMEOUT)
        except OSError as error:
            return str(error)


async def _arrives(call: Awaitable[object]) -> bool:
    try:
        await call
    except (NotFoundError, NoAnswerError):
        return False
    return True


async def _refusal(client: TruckClient) -> Reason | None:
    """Return the reason for refusing an obviously invalid order; None for another answer."""
    now = 0
    header = {"stamp": now, "received": now, "seq": now, "source": client.source, "role": client.role, "lease": 0.1}
    try:
        await client.call("arm", {**header, "nonce": ""})
    except RequestRefusedError as error:
        return error.refusal
    except TruckError:
        return None
    return Reason.OK


def _said(reason: Reason | None) -> str:
    return "no answer" if reason is None else reason.value
