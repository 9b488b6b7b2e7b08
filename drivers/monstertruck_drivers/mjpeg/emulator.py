"""Emulated camera that sends motion JPEG: plain, as a multipart answer, or picture by picture."""

import asyncio
from typing import Final

import numpy as np

from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.emulation import EmulatorSetup, ViewSource
from monstertruck_drivers.mjpeg.config import MjpegConfig
from monstertruck_drivers.mjpeg.protocol import HEAD_END
from monstertruck_drivers.signals import SignalKind, Signals
from monstertruck_drivers.webcam.emulator import jpeg
from monstertruck_runtime.clock import Clock, Schedule
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.threads import Offload, in_thread

BOUNDARY: Final = b"picture"
CHUNK: Final = 4095
"""Bytes written at a time: as many as the reader of a pty gets in one go."""


class MjpegEmulator:
    """Camera of a program or of a server; a server serves its latest client.

    Faults (``inject``): ``corrupt N`` (a header is overwritten), ``truncate N`` (the second half is missing),
    ``oversize N`` (zeros without an end), ``stuck on|off`` (sends nothing), ``status CODE|off`` (the server refuses),
    ``text on|off`` (it gives a page), ``chunked on|off``.

    Args:
        clock: time.
        view: source of the pictures.
        settings: size, rate, with or without HTTP.
        offload: runs the drawing: in a thread, or ``inline`` on the virtual clock.
    """

    def __init__(
        self, clock: Clock, view: ViewSource, settings: MjpegConfig | None = None, *, offload: Offload = in_thread
    ) -> None:
        self.name = "camera"
        self.signals = Signals(clock.now, {"image": SignalKind.THING}, np.random.default_rng(0))
        self._clock = clock
        self._view = view
        self._config = settings or MjpegConfig()
        self._offload = offload
        self._to_damage = {"corrupt": 0, "truncate": 0, "oversize": 0}
        self._switches = {"stuck": False, "text": False, "chunked": False}
        self._status = 200
        self._number = 0

    def power_cycle(self) -> None:
        """It counts from 0."""
        self._number = 0

    async def run(self, end: DeviceEnd) -> None:
        """Serve until cancelled."""
        if self._config.http is None:
            await self._stream(end)
        asked = b""
        serving: asyncio.Task[None] | None = None
        async with asyncio.TaskGroup() as group:
            while True:
                asked = (asked + await end.read())[-4096:]  # bytes of a request at most
                if HEAD_END in asked:
                    first, asked = asked.partition(b"\r\n")[0], b""
                    if serving is not None:
                        serving.cancel()
                    serving = group.create_task(self._answer(end, first))

    def inject(self, fault: str, *values: str) -> None:
        """Start or end a fault, see the class.

        Raises:
            InputError: unknown fault or bad value.
        """
        try:
            match fault, values:
                case (("corrupt" | "truncate" | "oversize"), (count,)):
                    self._to_damage[fault] = int(count)
                case (("stuck" | "text" | "chunked"), (("on" | "off") as state,)):
                    self._switches[fault] = state == "on"
                case "status", (code,):
                    self._status = 200 if code == "off" else int(code)
                case _:
                    raise ValueError("unknown")
        except ValueError as error:
            raise InputError(
                f"{self.name}: fault {' '.join((fault, *values))!r} not understood; known: corrupt|truncate|oversize "
                "N, stuck|text|chunked on|off, status CODE|off"
            ) from error

    async def _answer(self, end: DeviceEnd, first: bytes) -> None:
        if self._switches["stuck"]:
            return
        path = str(self._config.http).encode()
        status = self._status if first.split(b" ")[1:2] == [path] else 404
        single = self._config.poll is not None
        kind = b"image/jpeg" if single else b"multipart/x-mixed-replace; boundary=" + BOUNDARY
        if self._switches["text"]:
            kind = b"text/html"
        coding = b"Transfer-Encoding: chunked\r\n" if self._switches["chunked"] else b""
        picture = await self._picture(self._clock.now()) if single else b""
        if single and not coding:
            coding = b"Content-Length: %d\r\n" % len(picture)
        reason = b"OK" if status == 200 else b"Refused"
        end.write(b"HTTP/1.1 %d %s\r\n%sContent-Type: %s\r\n\r\n" % (status, reason, coding, kind))
        if status != 200 or self._switches["text"]:
            return
        if single:
            await self._send(end, picture)
            if self._switches["chunked"]:
                end.write(b"0\r\n\r\n")
        else:
            await self._stream(end)

    async def _stream(self, end: DeviceEnd) -> None:
        schedule = Schedule(self._clock, self._config.rate)
        while True:
            stamp = await schedule.next()
            if not self._switches["stuck"]:
                await self._send(end, await self._picture(stamp))

    async def _picture(self, stamp: int) -> bytes:
        number, size = self._number, (self._config.width, self._config.height)
        self._number += 1
        draw = self.signals.report("image", self._view.exposure(stamp, size))
        data = await self._offload(lambda: jpeg(draw(), number))
        if self._uses_up("corrupt"):
            data = data[:2] + bytes(4) + data[6:]
        if self._uses_up("truncate"):
            data = data[: len(data) // 2]
        if self._uses_up("oversize"):
            data = data[:-2] + bytes(self._config.most)
        return data

    async def _send(self, end: DeviceEnd, data: bytes) -> None:
        if self._config.http is not None and self._config.poll is None:
            head = b"--%s\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % (BOUNDARY, len(data))
            data = head + data + b"\r\n"
        for at in range(0, len(data), CHUNK):
            part = data[at : at + CHUNK]
            if self._switches["chunked"]:
                part = b"%x\r\n%s\r\n" % (len(part), part)
            await self._clock.sleep(0.0002)  # s
            end.write(part)

    def _uses_up(self, fault: str) -> bool:
        left = self._to_damage[fault]
        self._to_damage[fault] = max(0, left - 1)
        return left > 0


def emulated(setup: EmulatorSetup) -> MjpegEmulator:
    """The camera of a simulated robot."""
    return MjpegEmulator(setup.clock, setup.physics.view, setup.settings, offload=setup.offload)
