"""Emulated camera that sends motion JPEG: plain, as a multipart answer, or one picture per request."""

import asyncio
from typing import Final

import numpy as np

from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.emulation import EmulatorSetup, ViewSource
from monstertruck_drivers.fault_table import FaultTable, FaultyDevice
from monstertruck_drivers.mjpeg.config import MjpegConfig
from monstertruck_drivers.mjpeg.protocol import HEAD_END
from monstertruck_drivers.signals import SignalKind, Signals
from monstertruck_drivers.webcam.emulator import jpeg
from monstertruck_runtime.clock import Clock, Schedule
from monstertruck_runtime.threads import Offload, in_thread

BOUNDARY: Final = b"picture"
CHUNK: Final = 4095
"""Bytes written at a time: the maximum that the reader of a pty receives at once."""


class MjpegEmulator(FaultyDevice):
    """Camera behind a program or a server; a server serves its latest client.

    Faults (``inject``): ``corrupt N`` (a header is overwritten), ``truncate N`` (the second half is missing),
    ``oversize N`` (endless zeros), ``stuck on|off`` (sends nothing), ``status CODE|off`` (the server refuses),
    ``text on|off`` (it returns a page), ``chunked on|off``.

    Args:
        clock: time.
        view: source of the images.
        settings: size, rate, with or without HTTP.
        offload: runs the rendering in a thread, or ``inline`` with the virtual clock.
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
        self.faults = FaultTable(
            self.name,
            {
                "corrupt|truncate|oversize N": 0,
                "stuck|text|chunked on|off": False,
                "status CODE|off": self._answer_status,
            },
        )
        self._status = 200
        self._number = 0

    def power_cycle(self) -> None:
        """Restart the picture count at 0."""
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

    def _answer_status(self, code: str) -> None:
        self._status = 200 if code == "off" else int(code)

    async def _answer(self, end: DeviceEnd, first: bytes) -> None:
        if self.faults["stuck"]:
            return
        path = str(self._config.http).encode()
        status = self._status if first.split(b" ")[1:2] == [path] else 404
        single = self._config.poll is not None
        kind = b"image/jpeg" if single else b"multipart/x-mixed-replace; boundary=" + BOUNDARY
        if self.faults["text"]:
            kind = b"text/html"
        coding = b"Transfer-Encoding: chunked\r\n" if self.faults["chunked"] else b""
        picture = await self._picture(self._clock.now()) if single else b""
        if single and not coding:
            coding = b"Content-Length: %d\r\n" % len(picture)
        reason = b"OK" if status == 200 else b"Refused"
        end.write(b"HTTP/1.1 %d %s\r\n%sContent-Type: %s\r\n\r\n" % (status, reason, coding, kind))
        if status != 200 or self.faults["text"]:
            return
        if single:
            await self._send(end, picture)
            if self.faults["chunked"]:
                end.write(b"0\r\n\r\n")
        else:
            await self._stream(end)

    async def _stream(self, end: DeviceEnd) -> None:
        schedule = Schedule(self._clock, self._config.rate)
        while True:
            stamp = await schedule.next()
            if not self.faults["stuck"]:
                await self._send(end, await self._picture(stamp))

    async def _picture(self, stamp: int) -> bytes:
        number, size = self._number, (self._config.width, self._config.height)
        self._number += 1
        draw = self.signals.report("image", self._view.exposure(stamp, size))
        data = await self._offload(lambda: jpeg(draw(), number))
        if self.faults.strikes("corrupt"):
            data = data[:2] + bytes(4) + data[6:]
        if self.faults.strikes("truncate"):
            data = data[: len(data) // 2]
        if self.faults.strikes("oversize"):
            data = data[:-2] + bytes(self._config.most)
        return data

    async def _send(self, end: DeviceEnd, data: bytes) -> None:
        if self._config.http is not None and self._config.poll is None:
            head = b"--%s\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % (BOUNDARY, len(data))
            data = head + data + b"\r\n"
        for at in range(0, len(data), CHUNK):
            part = data[at : at + CHUNK]
            if self.faults["chunked"]:
                part = b"%x\r\n%s\r\n" % (len(part), part)
            await self._clock.sleep(0.0002)  # s
            end.write(part)


def emulated(setup: EmulatorSetup) -> MjpegEmulator:
    """Create a simulated robot's camera."""
    return MjpegEmulator(setup.clock, setup.physics.view, setup.settings, offload=setup.offload)
