"""Emulated camera that shows the simulated world."""

import asyncio
import errno
import io
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from monstertruck_drivers.cable import DeviceEnd, EmulatedPort
from monstertruck_drivers.emulation import EmulatorSetup, ViewSource
from monstertruck_drivers.fault_table import FaultTable, FaultyDevice
from monstertruck_drivers.signals import SignalKind, Signals
from monstertruck_drivers.webcam.packets import CameraPacket, PacketKind, encode_mode
from monstertruck_drivers.webcam.source import Mode
from monstertruck_runtime.clock import SECOND, Clock, Schedule
from monstertruck_runtime.threads import Offload, in_thread


def jpeg(picture: NDArray[np.uint8], counter: int) -> bytes:
    """Encode a picture of shape (height, width, 3) as JPEG, with ``counter`` encoded in its upper left corner."""
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image)
    text = f"{counter:06d}"
    draw.rectangle(draw.textbbox((8, 8), text, font=_font()), fill="black")
    draw.text((8, 8), text, fill="white", font=_font())
    out = io.BytesIO()
    image.save(out, "JPEG", quality=75)  # JPEG quality, 1..95
    return out.getvalue()


@cache
def _font() -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(20)


SIZES: Final = ((1600, 1200), (1280, 720), (800, 600), (640, 480), (320, 240), (160, 120))
"""Sizes offered; like a real driver, the emulator grants the nearest one."""
RATE_MAX: Final = 30.0
SIGNALS: Final = {
    "image": SignalKind.THING,
    "stamp": SignalKind.NUMBER,
    "open": SignalKind.SWITCH,
    "close": SignalKind.SWITCH,
}

REFUSALS: Final = {"EINVAL": errno.EINVAL, "EBUSY": errno.EBUSY, "ENOSPC": errno.ENOSPC, "off": 0}


class WebcamEmulator(FaultyDevice):
    """Camera that streams rendered JPEGs while a host requests them.

    The loop reads the world's state; ``offload`` runs rendering and compression.

    Faults (``inject``): ``drop N`` (pictures are counted, but not sent), ``corrupt N`` (start marker overwritten),
    ``truncate N`` (the second half is missing), ``bare on|off`` (no Huffman tables), ``jump SECONDS`` (added to all
    later stamps), ``stuck on|off`` (no stream and no answers), ``refuse EINVAL|EBUSY|ENOSPC|off`` (at the next
    openings), ``vanish [SECONDS]`` (the camera leaves USB while streaming, and returns).

    Args:
        clock: time.
        view: image source.
        offload: runs the rendering in a thread, or ``inline`` with the virtual clock.
        usb: the camera's port, for ``vanish``.
    """

    def __init__(
        self,
        clock: Clock,
        view: ViewSource,
        *,
        offload: Offload = in_thread,
        usb: EmulatedPort | None = None,
    ) -> None:
        self.name = "camera"
        self.usb = usb
        self.signals = Signals(clock.now, SIGNALS, np.random.default_rng(0))
        self._clock = clock
        self._view = view
        self._offload = offload
        self._wanted = asyncio.Event()
        self.faults = FaultTable(
            self.name,
            {
                "drop|corrupt|truncate N": 0,
                "bare|stuck on|off": False,
                "jump SECONDS": 0.0,
                "refuse EINVAL|EBUSY|ENOSPC|off": self._refuse,
                "vanish [SECONDS]": self._vanish,
            },
        )
        self._refusal = 0
        self.power_cycle()

    def power_cycle(self) -> None:
        """Switch the supply off and on: streaming ends, and the count restarts at 0."""
        self._sequence = 0
        self._session = 0
        self._size = SIZES[0]
        self._rate = RATE_MAX
        self._wanted.clear()

    async def run(self, end: DeviceEnd) -> None:
        """Serve until cancelled."""
        end.on_plug = lambda _: self.power_cycle()
        async with asyncio.TaskGroup() as group:
            group.create_task(self._listen(end))
            group.create_task(self._stream(end))

    def _refuse(self, how: str) -> None:
        self._refusal = REFUSALS[how]

    # Serving

    async def _listen(self, end: DeviceEnd) -> None:
        buffer = b""
        while True:
            *lines, buffer = (buffer + await end.read())[-256:].split(b"\n")  # bytes of a line at most
            for line in lines:
                self._obey(end, line)

    def _obey(self, end: DeviceEnd, line: bytes) -> None:
        match line.split():
            case [b"OPEN", *numbers]:
                try:
                    width, height, rate = (float(number) for number in numbers)
                except ValueError:
                    return
                self.signals.order("open", rate, lambda granted: self._open(end, width, height, granted))
            case [b"CLOSE"]:
                self.signals.order("close", None, lambda _: self._wanted.clear())
            case _:
                pass

    def _open(self, end: DeviceEnd, width: float, height: float, rate: float) -> None:
        if self._refusal:
            end.write(CameraPacket(PacketKind.REFUSED, self._refusal).encode())
            return
        size = min(SIZES, key=lambda offered: abs(offered[0] - width) + abs(offered[1] - height))
        granted = Mode(*size, min(max(rate, 1.0), RATE_MAX))
        self._size, self._rate = size, granted.rate
        self._session += 1
        self._wanted.set()
        end.write(CameraPacket(PacketKind.GRANTED, payload=encode_mode(granted)).encode())

    async def _stream(self, end: DeviceEnd) -> None:
        while True:
            await self._wanted.wait()
            session = self._session
            schedule = Schedule(self._clock, self._rate, ahead=-self._clock.now())  # separate clock
            while self._wanted.is_set() and session == self._session:
                stamp = await schedule.next()
                if self._wanted.is_set() and session == self._session:
                    await self._expose(end, stamp)

    async def _expose(self, end: DeviceEnd, stamp: int) -> None:
        if self.faults["stuck"]:
            return
        number = self._sequence
        self._sequence += 1
        if self.faults.strikes("drop"):
            return
        draw = self.signals.report("image", self._view.exposure(stamp, self._size))
        stamp = self.signals.report("stamp", stamp)
        data = self._damaged(await self._offload(lambda: jpeg(draw(), number)))
        packet = CameraPacket(PacketKind.PICTURE, number, stamp + round(self.faults["jump"] * SECOND), data).encode()
        chunk = 4095  # bytes written at a time: as many as the reader of a pty gets in one go
        for at in range(0, len(packet), chunk):
            await self._clock.sleep(0.0002)  # s
            end.write(packet[at : at + chunk])

    def _damaged(self, data: bytes) -> bytes:
        if self.faults["bare"]:
            # Four segments, of one table each, as the encoder writes them.
            head, _, tail = data.partition(b"\xff\xc4")
            data = head + tail[tail.index(b"\xff\xda") :]
        if self.faults.strikes("corrupt"):
            data = bytes(4) + data[4:]
        if self.faults.strikes("truncate"):
            data = data[: len(data) // 2]
        return data

    def _vanish(self, seconds: str = "0.5") -> None:
        if self.usb is None:
            self.power_cycle()
        else:
            self.usb.unplug()
            asyncio.get_running_loop().call_later(float(seconds), self.usb.plug)


def emulated(setup: EmulatorSetup) -> WebcamEmulator:
    """Create a simulated truck's camera."""
    return WebcamEmulator(setup.clock, setup.physics.view, offload=setup.offload, usb=setup.port)
