"""The camera at a path, whichever is there: the real one, or the emulated one of another process."""

from pathlib import Path
from typing import Final

from monstertruck_drivers.link import SerialPort
from monstertruck_drivers.webcam.rendered_source import RenderedSource
from monstertruck_drivers.webcam.source import FrameSource, FrameStream, Mode
from monstertruck_drivers.webcam.v4l2_source import V4l2Source
from monstertruck_runtime.clock import Clock

PTYS: Final = Path("/dev/pts")


class PathSource:
    """Looks at every opening whether the path leads to a pty, behind which only an emulator can be.

    Args:
        path: node, symlink or glob pattern, see ``V4l2Source``.
        clock: time.
    """

    def __init__(self, path: str, clock: Clock) -> None:
        self.name = path
        self._clock = clock

    async def open(self, mode: Mode, buffers: int) -> FrameStream:
        """Start the camera, see ``FrameSource``."""
        return await self._present().open(mode, buffers)

    def _present(self) -> FrameSource:
        path = Path(self.name)
        if path.resolve().parent == PTYS:
            return RenderedSource(SerialPort(path), self._clock)
        return V4l2Source(self.name)
