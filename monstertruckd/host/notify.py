"""Notifications to systemd: ready, alive, stopping (sd_notify(3) protocol). Alive means the tick keeps its pace."""

import os
import socket
from collections.abc import Callable, Iterable, Mapping
from typing import Protocol

from monstertruck_runtime.clock import Clock
from monstertruck_runtime.ports import Ready
from monstertruck_schemas.health import ServiceHealth, ServiceState
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.state import GateMode


class Notify(Protocol):
    """Sends lines to systemd; returns whether they arrived."""

    def __call__(self, *lines: str) -> bool:
        """Send the lines as one message, or lose them."""


def notify_socket(address: str) -> Notify:
    """Return a sender to a socket path, or to an abstract socket with a leading @. It never blocks or raises."""
    name = "\0" + address[1:] if address.startswith("@") else address

    def send(*lines: str) -> bool:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as sender:
            try:
                return sender.sendto("\n".join(lines).encode(), name) > 0
            except OSError:
                return False

    return send


def watchdog_seconds(environment: Mapping[str, str], pid: int) -> float | None:
    """Return the watchdog timeout of systemd (s); None without a watchdog or if it is for another process."""
    try:
        seconds = int(environment["WATCHDOG_USEC"]) / 1e6
        meant = int(environment.get("WATCHDOG_PID") or pid)
    except (KeyError, ValueError):
        return None
    return seconds if seconds > 0 and meant == pid else None


class NotifyService:
    """Sends systemd READY once the daemon is up and the tick runs, then pings while the tick keeps its pace.

    Args:
        send: sends lines to systemd.
        watchdog: watchdog timeout (s); None to send only the status and no pings.
        clock: time source.
        ticks: returns the number of control ticks so far.
        rate: nominal ticks per second.
        status: returns the state of the robot in one line.
    """

    name = ServiceName.NOTIFY.value

    def __init__(
        self,
        send: Notify,
        watchdog: float | None,
        clock: Clock,
        ticks: Callable[[], int],
        rate: float,
        status: Callable[[], str],
    ) -> None:
        self._send = send
        self._ping = ("WATCHDOG=1",) if watchdog is not None else ()
        self._period = 1.0 if watchdog is None else watchdog / 3  # interval between checks (s) without a watchdog
        self._clock = clock
        self._ticks = ticks
        # 0.5: minimum fraction of the nominal ticks between checks; with fewer, the tick is hanging
        self._enough = 0.5 * rate * self._period
        self._status = status
        self._up = False
        self._seen_ticks = 0
        self._sent_status = ""

    def up(self) -> None:
        """Note that everything has been started; from now on only the tick decides."""
        self._up = True

    def stopping(self) -> None:
        """Notify systemd that the daemon exits on purpose."""
        self._send("STOPPING=1", "STATUS=stopping")

    async def run(self, ready: Ready) -> None:
        """Notify systemd until cancelled."""
        ready()
        while not (self._up and self._ticks() and self._notify("READY=1")):
            await self._clock.sleep(0.02)  # interval between checks until the first tick (s)
        while True:
            await self._clock.sleep(self._period)
            self._notify()

    def _notify(self, *first: str) -> bool:
        """Send changes and pings; a status that did not arrive is sent again next time.

        A ping depends only on the ticks since the last check, sent or not: a slow gate must not accumulate them.
        """
        ticks, status = self._ticks(), self._status()
        kept_pace = ticks - self._seen_ticks >= self._enough
        self._seen_ticks = ticks
        lines = [*first]
        if first or kept_pace:
            lines += self._ping
        if status != self._sent_status:
            lines.append(f"STATUS={status}")
        if not lines or not self._send(*lines):
            return False
        self._sent_status = status
        return True


def status_line(mode: GateMode, services: Iterable[ServiceHealth]) -> str:
    """Return the robot's state in one line: the gate mode, and the services that are not ready."""
    down = [f"{row.name} ({row.state.value})" for row in services if row.state is not ServiceState.READY]
    return f"{mode.value}; not ready: {', '.join(down)}" if down else mode.value


def notify_from(
    environment: Mapping[str, str], clock: Clock, ticks: Callable[[], int], rate: float, status: Callable[[], str]
) -> NotifyService | None:
    """Create the service for this process; None if systemd does not expect notifications."""
    address = environment.get("NOTIFY_SOCKET", "")
    if not address.startswith(("/", "@")):
        return None
    watchdog = watchdog_seconds(environment, os.getpid())
    return NotifyService(notify_socket(address), watchdog, clock, ticks, rate, status)
