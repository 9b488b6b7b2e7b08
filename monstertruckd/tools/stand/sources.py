"""Sources of images: cameras of the computer, films, folders of images."""

import asyncio
import queue
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from monstertruck_drivers.tty import SerialPort
from monstertruck_drivers.webcam.driver import complete
from monstertruck_drivers.webcam.rendered_source import RenderedSource
from monstertruck_drivers.webcam.source import Mode
from monstertruck_estimation.vision.tags import Picture
from monstertruck_runtime.clock import WallClock
from monstertruck_runtime.errors import DeviceLostError, InputError, TruckError
from monstertruck_runtime.outside import picture, require_pixels
from monstertruckd.tools.stand.config import FileSource, RenderedCamera, VideoDevice

ENDINGS: Final = (".png", ".jpg", ".jpeg", ".pgm")


FLAGS: Final = {False: cv2.IMREAD_GRAYSCALE, True: cv2.IMREAD_COLOR}
"""Flags of OpenCV's readers, for grey (False) and colour (True)."""


def pictures_in(folder: Path) -> list[Picture]:
    """Return all images of a folder in the order of their names, grey.

    Raises:
        InputError: there are none, or one cannot be read.
    """
    return [_read(path, colour=False) for path in _files(folder)]


def _files(folder: Path) -> list[Path]:
    files = sorted(path for path in folder.glob("*") if path.suffix.lower() in ENDINGS) if folder.is_dir() else []
    if not files:
        raise InputError(f"{folder}: contains no images ({', '.join(ENDINGS)}): take some with `stand snap`")
    return files


def stream(
    source: VideoDevice | FileSource | RenderedCamera, size: tuple[int, int], rate: float, *, colour: bool = False
) -> Iterator[Picture]:
    """Iterate over images, grey or blue, green and red; blocks for each.

    Raises:
        DeviceLostError: the camera is missing, or sends no more images.
        InputError: a film or image cannot be read.
    """
    if isinstance(source, FileSource):
        if source.path.is_dir():
            for path in _files(source.path):  # one at a time: a minute of six cameras is 3 GB
                yield _read(path, colour=colour)
            return
        capture = cv2.VideoCapture(str(source.path))
        yield from _frames(source.path, capture, InputError("cannot be read as a video"), colour=colour)
        return
    if isinstance(source, RenderedCamera):
        yield from _rendered(source.port, Mode(*size, rate), colour=colour)
        return
    capture = cv2.VideoCapture(str(source.device), cv2.CAP_V4L2)
    for what, value in (
        (cv2.CAP_PROP_FRAME_WIDTH, size[0]),
        (cv2.CAP_PROP_FRAME_HEIGHT, size[1]),
        (cv2.CAP_PROP_FPS, rate),
        (cv2.CAP_PROP_BUFFERSIZE, 1),
    ):
        capture.set(what, value)
    yield from _frames(source.device, capture, DeviceLostError("cannot be opened"), colour=colour)
    raise DeviceLostError(f"{source.device}: stopped sending images")


def _rendered(port: Path, mode: Mode, *, colour: bool) -> Iterator[Picture]:
    """Yield images of an emulated camera; each request returns the latest."""
    box: queue.Queue[bytes | BaseException] = queue.Queue(1)
    ended = threading.Event()
    # A separate thread reads continuously, because a pty buffers only 4 kB.
    reading = threading.Thread(target=_read_port, args=(port, mode, box, ended), name=f"camera {port}", daemon=True)
    reading.start()
    try:
        while True:
            found = box.get()
            if isinstance(found, BaseException):
                raise found
            frame = cv2.imdecode(np.frombuffer(found, np.uint8), FLAGS[colour])
            if frame is not None:
                yield np.asarray(frame, dtype=np.uint8)
    finally:
        ended.set()


def _read_port(port: Path, mode: Mode, box: "queue.Queue[bytes | BaseException]", ended: threading.Event) -> None:
    def put(found: bytes | BaseException) -> None:
        with suppress(queue.Empty):
            box.get_nowait()
        box.put(found)

    async def read() -> None:
        async with await RenderedSource(SerialPort(port), WallClock()).open(mode, buffers=2) as stream:
            while not ended.is_set():
                with suppress(ValueError):  # truncated
                    put(complete((await stream.next()).data))

    try:
        asyncio.run(read())
    except TruckError as error:
        put(error)


def _frames(name: Path, capture: cv2.VideoCapture, closed: Exception, *, colour: bool) -> Iterator[Picture]:
    try:
        if not capture.isOpened():
            raise type(closed)(f"{name}: {closed}")
        width, height = capture.get(cv2.CAP_PROP_FRAME_WIDTH), capture.get(cv2.CAP_PROP_FRAME_HEIGHT)
        require_pixels(name, width, height)
        while True:
            there, frame = capture.read()
            if not there:
                return
            yield np.asarray(frame) if colour else _grey(np.asarray(frame))
    finally:
        capture.release()


def _read(path: Path, *, colour: bool) -> Picture:
    """Read an image with the library that has checked its size; OpenCV's reader trusts the lengths in the file."""
    with picture(path) as image:
        deep = image.mode.startswith("I")  # 16 bits in 32
        shades = np.asarray(image.convert("I" if deep else "RGB" if colour else "L"))
        grey = (np.clip(shades, 0, 65535) // 257).astype(np.uint8) if deep else shades
        return np.ascontiguousarray(_coloured(grey) if colour else grey)


def _coloured(shades: np.ndarray) -> np.ndarray:
    """Convert a grey or RGB image to blue, green and red."""
    return np.repeat(shades[..., None], 3, axis=2) if shades.ndim == 2 else shades[..., ::-1]


def _grey(frame: np.ndarray) -> Picture:
    if frame.ndim == 2:
        return frame.astype(np.uint8)
    return np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
