"""Animated GIF, written frame by frame with bounded memory."""

from contextlib import ExitStack
from io import BufferedWriter
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from PIL import GifImagePlugin, Image, ImageChops

from monstertruck_runtime.small_files import whole_file

LONGEST_FRAME: Final = 65_535
"""Maximum display time of a frame, hundredths of a second (GIF89a, 23: 16 bits)."""


class MovingPicture:
    """Writes a GIF atomically; a context manager.

    Keeps only the latest frame and the differences between frames in memory.

    Args:
        file: file to write, replaced at the end; without a frame no file is written.
        seconds: display time of a frame.
        rest: display time of the last frame; None: as the others.
    """

    def __init__(self, file: Path, seconds: float, rest: float | None = None) -> None:
        self._file = file
        self._shown = round(100 * seconds)
        self._rest = self._shown if rest is None else round(100 * rest)
        self._made = ExitStack()
        self._out: BufferedWriter | None = None
        self._palette = b""
        self._newest: Image.Image | None = None
        self._waiting: tuple[Image.Image, tuple[int, int], int] | None = None
        """Part of a frame, its position, and its display time, hundredths of a second."""
        self.count = 0
        """Number of frames so far, including repeated ones."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
        else:
            self._made.__exit__(kind, error, trace)

    def add(self, picture: Image.Image) -> None:
        """Add a frame with a palette.

        Raises:
            OSError: it cannot be written.
        """
        self.count += 1
        if self._newest is None:
            part, place = picture, (0, 0)
        else:
            box = ImageChops.difference(picture.convert("RGB"), self._newest.convert("RGB")).getbbox()
            assert self._waiting is not None
            before, where, duration = self._waiting
            if box is None and duration + self._shown <= LONGEST_FRAME:
                self._waiting = before, where, duration + self._shown
                return
            box = box or (0, 0, 1, 1)
            part, place = picture.crop(box), (box[0], box[1])
            self._write()
        self._newest, self._waiting = picture, (part, place, self._shown)

    def close(self) -> None:
        """Write the last frame and the trailer of the file.

        Raises:
            OSError: it cannot be written.
        """
        with self._made:
            if self._waiting is not None:
                part, place, duration = self._waiting
                self._waiting = part, place, min(duration - self._shown + self._rest, LONGEST_FRAME)
                self._write()
            if self._out is not None:
                self._out.write(b";")

    def _write(self) -> None:
        assert self._waiting is not None
        part, place, duration = self._waiting
        palette = bytes(part.getpalette() or ())
        if self._out is None:
            self._out = self._made.enter_context(self._made.enter_context(whole_file(self._file)).open("wb"))
            self._palette = palette
            # On a copy, because it modifies its image.
            self._out.writelines(GifImagePlugin.getheader(part.copy(), info={"loop": 0, "optimize": False})[0])
        own = palette != self._palette
        self._out.writelines(
            GifImagePlugin.getdata(part, place, duration=10 * duration, disposal=1, include_color_table=own)
        )
