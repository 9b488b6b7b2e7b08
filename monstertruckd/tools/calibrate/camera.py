"""Camera lens, and camera mount relative to the lidar, from a board held in view of both.

The lens uses Zhang's method (``monstertruck_estimation.vision.lens``), the mount the method of Zhang and Pless
(``board_mount``). The robot does not drive. The operator holds the board still for a moment in one pose after another,
and the wizard lists the missing views.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Final, Self

import cv2
import numpy as np

from monstertruck_drivers.scanning.mounting import upright
from monstertruck_estimation.vision.board import BoardReader
from monstertruck_estimation.vision.lens import PARAMETERS, Lens, LensFit, fit_lens
from monstertruck_estimation.vision.tags import Picture
from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.errors import InputError, RequestRefusedError
from monstertruck_schemas import topics
from monstertruck_schemas.board import BoardConfig
from monstertruck_schemas.body import LensConfig
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import CompressedImage
from monstertruckd.config.calibration import Estimate, Result, WizardName
from monstertruckd.config.wizards import CAMERA_LENS, CAMERA_MOUNT
from monstertruckd.tools.calibrate.board_mount import NAMES, LidarPlace, fit_mount, line_on_board
from monstertruckd.tools.calibrate.board_views import BoardGuide, BoardView
from monstertruckd.tools.calibrate.lidar import joint_angles
from monstertruckd.tools.calibrate.statistics import NORMAL, Interval, estimated, known_errors
from monstertruckd.tools.calibrate.steps import Collect, Confirm, Plot, WatchStep
from monstertruckd.tools.calibrate.wizard import WizardContext

ROOM: Final = (
    "a printed board on a flat plate (`stand print`), held 0.4 to 1 m from the camera in good light; the "
    "robot does not drive"
)
FIRST: Final = 3
"""Number of images that determine the image size."""
KEPT: Final = math.radians(0.7)
"""Tolerated rotation of the lidar's joints during the run (rad): two servo steps."""
UNITS: Final = {"focal_x": "px", "focal_y": "px", "centre_x": "px", "centre_y": "px"}

_BOARD: Final = Confirm(
    "board",
    "Hold the board in front of the camera for a second in each pose: tilted in all directions, across "
    "the whole image. Start?",
)


@dataclass(frozen=True, slots=True)
class CameraWizard:
    """Wizard that collects images and scans of a board until there are enough."""

    name: ClassVar[WizardName] = "camera"
    doc: ClassVar[str] = "camera lens, and camera pose relative to the lidar, from a board held in front of both"
    room: ClassVar[str] = ROOM
    board: BoardConfig = field(default_factory=BoardConfig)
    lidar: bool = True
    """Also fit the mount if the robot has a lidar"""
    patience: float = 60.0
    """Timeout without a new view (s)"""

    @classmethod
    def of(cls, columns: int, rows: int, square: float, marker: float, lens_only: bool, patience: float) -> Self:
        """Create a wizard from the command's options; lengths in m.

        Raises:
            InputError: a marker is larger than its square.
        """
        if marker >= square:
            text = f"expected less than --square {1000 * square:g}, the square around the marker"
            raise InputError(f"--marker {1000 * marker:g}: {text}")
        return cls(BoardConfig(columns=columns, rows=rows, square=square, marker=marker), not lens_only, patience)

    async def __call__(self, context: WizardContext) -> Result:
        """Measure."""
        device = context.config.devices.camera
        if device is None or not isinstance(believed := getattr(device.driver, "lens", None), LensConfig):
            raise RequestRefusedError(
                Reason.NOT_SUPPORTED, "this robot has no camera whose driver takes lens parameters"
            )
        first = await context.collect(Collect("a picture", topics.CAMERA, FIRST))
        shapes = [picture.shape for message in first if (picture := decoded(message)) is not None]
        if not shapes:
            raise InputError(f"none of {FIRST} images of the camera can be decoded: check its cable and hub")
        height, width = shape = shapes[0]
        reader, lens = BoardReader(self.board), Lens.of(believed, width, height)
        mount = np.array([getattr(device.mount, name) for name in NAMES])
        lidar = await self._lidar(context) if self.lidar else None

        def crossed(view: BoardView) -> bool:
            return lidar is not None and line_on_board(view, reader, lens, mount, lidar, known=False) is not None

        guide = BoardGuide(reader, lens, None if lidar is None else crossed, self.patience)
        await context.confirm(_BOARD)

        def take(message: CompressedImage, others: dict[str, list[Any]]) -> tuple[float, float]:
            scans, picture = others.get(topics.SCAN.name, []), decoded(message)
            if picture is not None and picture.shape != shape:
                now = " x ".join(map(str, picture.shape[::-1]))
                raise InputError(f"the image size changed from {width} x {height} to {now} pixels: start again")
            sighting = None if picture is None else reader.read(picture)
            if guide.take(message.stamp, sighting, scans, damaged=picture is None) is not None:
                corners = np.vstack([view.sighting.corners for view in guide.views]) * (1.0, -1.0)
                context.plot(Plot("corners of the board in the picture", "right (px)", "up (px)", corners))
                missing = guide.missing()
                if missing:
                    context.say(f"view {len(guide.views)}; still missing: {'; '.join(missing[:2])}")
            return guide.progress()

        also = () if lidar is None else (topics.SCAN,)
        await context.watch(WatchStep("views of the board", topics.CAMERA, take, also))
        found, views = context.fit("lens", lambda: lens_of(guide.views, reader, (width, height)))
        if lidar is None:
            return result_of(found, len(views))
        check_kept(lidar, await self._lidar(context))
        halves = lidar_halves(context)
        placed = context.fit("mount", lambda: mount_of(views, reader, found, mount, lidar, halves))
        return result_of(found, len(views), placed)

    async def _lidar(self, context: WizardContext) -> LidarPlace | None:
        """Return the lidar's pose at the current angles of its mount joints."""
        devices = context.config.devices
        if devices.lidar is None:
            return None
        return LidarPlace.of(upright(devices.lidar.mount), *await joint_angles(context))


def decoded(message: CompressedImage) -> Picture | None:
    """Decode to a grey image, shape (height, width); None if it is damaged, as images from some webcams are."""
    if not message.data:
        return None
    grey: Picture | None = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_GRAYSCALE)
    return grey


def check_kept(before: LidarPlace, after: LidarPlace | None) -> None:
    """Reject the views if the lidar's joints turned during the run.

    Possible causes: the operator leant on the truck, or the ground gave way.

    Raises:
        InputError: the joints have turned.
    """
    turn = 0.0 if after is None else float(np.linalg.norm(cv2.Rodrigues(before.axes.T @ after.axes)[0]))
    if turn > KEPT:
        raise InputError(
            f"the stabiliser turned the lidar by {math.degrees(turn):.1f} degrees during the measurement: "
            "place the robot firmly, do not lean on it, and start again"
        )


def lens_of(views: Sequence[BoardView], reader: BoardReader, size: tuple[int, int]) -> tuple[LensFit, list[BoardView]]:
    """Fit the lens; return the fit and the views used. Views with large corner errors are dropped.

    Raises:
        InputError: no lens fits the corners.
    """
    found = fit_lens([view.sighting for view in views], reader, size)
    kept = list(views)
    off = np.array(found.by_view)
    stray = 3.0  # maximum corner error of a view, as a multiple of the median
    if (off > stray * np.median(off)).any():
        kept = [view for view, one in zip(views, off.tolist(), strict=True) if one <= stray * np.median(off)]
        found = fit_lens([view.sighting for view in kept], reader, size)
    worst = 1.0  # maximum RMS corner error (px)
    if found.rms > worst:
        raise InputError(
            f"corners deviate by {found.rms:.1f} pixels (expected {worst:g} at most): the board is bent, "
            "it moved, or the lens does not follow the pinhole model with radial distortion"
        )
    return found, kept


@dataclass(frozen=True, slots=True)
class PlacedMount:
    """Measured camera mount."""

    values: dict[str, Interval]
    """Mount values, by ``NAMES``."""
    size: Interval
    """Board size, as a fraction of the stated size."""
    lines: int


def mount_of(
    views: Sequence[BoardView],
    reader: BoardReader,
    found: LensFit,
    mount: Array,
    lidar: LidarPlace,
    lidar_mount: dict[str, float],
) -> PlacedMount:
    """Fit the mount, given the lens and the lidar's mount.

    Args:
        views: views of the board.
        reader: reader that found the boards.
        found: fitted lens.
        mount: configured mount, ``NAMES``.
        lidar: pose of the lidar.
        lidar_mount: half-widths of the intervals of the lidar mount, by name.

    Raises:
        InputError: see ``fit_mount``; also raised if the views do not determine the mount.
    """
    fx, fy = found.lens.parameters[:2]
    focal = float(np.hypot(*found.sigmas[:2] / (fx, fy)) / math.sqrt(2))
    fit, lines = fit_mount(views, reader, found.lens, mount, lidar, focal)
    halves = known_errors(fit, 2 * len(lines) - len(NAMES))
    if not np.isfinite(halves).all():
        raise InputError(
            "the views do not determine the mount: it is more than half a metre off, or the board was never tilted"
        )
    # The lens axis is known as accurately as its centre in the image.
    axis = {"yaw": NORMAL * found.sigmas[2] / fx, "pitch": NORMAL * found.sigmas[3] / fy}
    values = {
        name: Interval(float(value), float(half)).joined(axis.get(name, 0.0)).joined(lidar_mount.get(name, 0.0))
        for name, value, half in zip(NAMES, fit.parameters, halves, strict=False)
    }
    return PlacedMount(values, Interval(float(fit.parameters[6]), float(halves[6])), len(lines))


def lidar_halves(context: WizardContext) -> dict[str, float]:
    """Half-widths of the lidar mount from its calibration (m and rad); empty if the lidar was not calibrated."""
    known = context.known.get("lidar")
    estimates = () if known is None else known.estimates
    return {e.name: (e.high - e.low) / 2 for e in estimates if e.low is not None and e.high is not None}


def result_of(found: LensFit, views: int, placed: PlacedMount | None = None) -> Result:
    """Assemble the result; without ``placed``, it contains only the lens."""
    lens, (width, height) = found.lens, found.lens.size
    sized = "image size that the lens parameters apply to"
    estimates = [
        Estimate(name=name, value=value, unit="px", samples=views, meaning=sized, key=f"{CAMERA_LENS}.{name}")
        for name, value in (("width", width), ("height", height))
    ]
    for name, value, sigma in zip(PARAMETERS, lens.parameters.tolist(), found.sigmas.tolist(), strict=True):
        interval = Interval(value, NORMAL * sigma)
        text = "Brown's lens model; 95 % interval of the corners"
        key = f"{CAMERA_LENS}.{name}"
        estimates.append(estimated(name, interval, UNITS.get(name, ""), found.corners, text, key))
    zero = "sixth-order radial distortion, not fitted"
    estimates.append(Estimate(name="k3", value=0.0, samples=views, meaning=zero, key=f"{CAMERA_LENS}.k3"))
    if placed is not None:
        noise = "95 % interval from line and plane, lens and print, and the lidar's mount where it was calibrated"
        for name, interval in placed.values.items():
            unit = "m" if name in ("x", "y", "z") else "rad"
            text = f"of the camera on the body, relative to the lidar's mount; {noise}"
            estimates.append(estimated(name, interval, unit, placed.lines, text, f"{CAMERA_MOUNT}.{name}"))
        text = "scale of the board relative to the stated size, from lidar and ruler; for information"
        estimates.append(estimated("board_size", placed.size, "", placed.lines, text))
    crossed = "" if placed is None else f", {placed.lines} across the lidar's beam"
    return Result(
        wizard="camera",
        measured=f"{views} views of a board{crossed}; corner residual {found.rms:.2f} pixels",
        estimates=tuple(estimates),
        unobserved=(
            "a bent board: its corners yield a wrong lens",
            *(("the mount: it is measured only together with the lidar",) if placed is None else ()),
            *(
                ("height and tilt of the lidar itself: the camera's values are relative to them",)
                if placed is not None
                else ()
            ),
        ),
        partial=placed is None,
    )
