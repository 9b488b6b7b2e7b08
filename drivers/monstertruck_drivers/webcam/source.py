"""Picture source: the interface shared by the real and the emulated camera."""

import errno
from dataclasses import dataclass
from typing import Final, Protocol, Self

from monstertruck_runtime.errors import (
    DeviceError,
    DeviceFaultError,
    DeviceLostError,
    DeviceMismatchError,
    DeviceTimeoutError,
    PortBusyError,
)


@dataclass(frozen=True, slots=True)
class Mode:
    """Settings requested from a camera or granted by it."""

    width: int
    height: int
    rate: float
    """Picture rate (Hz)."""

    def __str__(self) -> str:
        return f"{self.width}x{self.height} at {self.rate:g} Hz"


@dataclass(frozen=True, slots=True)
class CameraFrame:
    """One unchecked picture as sent by the camera."""

    stamp: int | None
    """Time of exposure on CLOCK_MONOTONIC (ns); None: unknown."""
    sequence: int
    """Picture count of the camera."""
    data: bytes
    damaged: bool = False
    """The kernel marked the picture as incomplete."""


class FrameStream(Protocol):
    """Stream from a camera."""

    mode: Mode
    """Granted mode; it may differ from the requested one."""

    async def next(self) -> CameraFrame:
        """Wait for a picture newer than the last one; older pictures are dropped.

        Raises:
            DeviceLostError: the camera was unplugged.
            DeviceError: the camera failed in another way.
        """

    async def __aenter__(self) -> Self:
        """Return the stream itself."""

    async def __aexit__(self, *_: object) -> None:
        """Stop and release the camera."""


class FrameSource(Protocol):
    """Place that a camera may be plugged into."""

    name: str

    async def open(self, mode: Mode, buffers: int) -> FrameStream:
        """Start the camera.

        Raises:
            DeviceLostError: no camera is plugged in.
            PortBusyError: another program is streaming from the camera.
            DeviceMismatchError: the camera does not offer motion JPEG or refuses the mode.
            DeviceFaultError: the camera's hub has no bandwidth left.
            DeviceError: any other failure.
        """


_KINDS: Final[dict[int, type[DeviceError]]] = {
    errno.ENODEV: DeviceLostError,
    errno.ENXIO: DeviceLostError,
    errno.ENOENT: DeviceLostError,
    errno.EIO: DeviceLostError,
    errno.EBUSY: PortBusyError,
    errno.ENOSPC: DeviceFaultError,
    errno.ETIMEDOUT: DeviceTimeoutError,
}
_HINTS: Final = {
    errno.ENOSPC: "no USB bandwidth left on its hub: choose a smaller image size, or use a port of another hub",
    errno.EACCES: "no permission: the user must be in the group 'video'",
    errno.EBUSY: "another program uses the camera",
}


def device_error(name: str, doing: str, error: OSError) -> DeviceError:
    """Translate a kernel error number for a camera; EINVAL during ``set the format`` is a mismatch."""
    number = error.errno or 0
    kind = _KINDS.get(number, DeviceError)
    if number == errno.EINVAL and doing == SET_FORMAT:
        kind = DeviceMismatchError
    return kind(f"{name}: cannot {doing}: {_HINTS.get(number) or error.strerror}")


SET_FORMAT: Final = "set the format"
"""Step in which a camera refuses a mode."""
