"""An animated GIF that is written picture by picture, however long it gets."""

from contextlib import ExitStack
from io import BufferedWriter
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from PIL import GifImagePlugin, Image, ImageChops

from monstertruck_runtime.small_files import whole_file

LONGEST_FRAME: Final = 65_535
"""Maximum display time of a picture, hundredths of a second (GIF89a, 23: 16 bits)."""


class MovingPicture:
    """Writes a GIF, as a whole or not at all; a context manager.

    Only the latest picture is kept, and the differences between pictures.

    Args:
        file: takes the place of an older one at the end; without a picture there is none.
        seconds: display time of a picture.
        rest: display time of the last one; None for that of the others.
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
        """Part of a picture, its place, and how long it stands, hundredths of a second."""
        self.count = 0
        """Pictures so far, those that look like the one before too."""

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
        """Add a picture with a palette.

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
        """Write the last picture and the end of the file.

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
            # Of a copy: it changes its picture.
            self._out.writelines(GifImagePlugin.getheader(part.copy(), info={"loop": 0, "optimize": False})[0])
        own = palette != self._palette
        self._out.writelines(
            GifImagePlugin.getdata(part, place, duration=10 * duration, disposal=1, include_color_table=own)
        )
