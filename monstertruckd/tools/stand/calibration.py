"""Calibration of the stand: lenses by a board, camera poses by marks on the table, joined by marks that several see.

The marks are tags whose centres were measured with a ruler. A mark seen by two cameras must be at one place for both:
the poses of all cameras are fitted together, by least squares of points on the table.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Final, Literal

import cv2
import numpy as np
from pydantic import Field

from monstertruck_estimation.vision.board import BoardReader
from monstertruck_estimation.vision.lens import Lens, LensFit, lens_from_pictures
from monstertruck_estimation.vision.tags import Picture, Sighting, TagReader
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.fitting import least_squares
from monstertruck_runtime.errors import ConfigError, InputError
from monstertruck_runtime.outside import contents, reading
from monstertruck_runtime.small_files import MEGABYTE, make_folder, replace_file
from monstertruck_schemas.base import Schema
from monstertruckd.tools.stand.camera import PlacedCamera, meet, rotation_matrix
from monstertruckd.tools.stand.config import MarkConfig, OverheadConfig

Numbers = Annotated[tuple[float, ...], Field(strict=False)]

LEAST_MARKS: Final = 5
"""Minimum number of marks that a camera must see."""


class CameraCalibration(Schema):
    """Calibration of one camera."""

    matrix: Numbers
    """3 x 3, row-major (pixels)"""
    distortion: Numbers
    """k1, k2, p1, p2, k3"""
    size: Annotated[tuple[int, int], Field(strict=False)]
    rotation: Numbers
    translation: Numbers
    lens_rms: float
    """RMS error of the board's corners (pixels)"""
    place_rms: float
    """RMS error of the marks (m)"""
    boards: int
    marks: int


class StandCalibration(Schema):
    """Calibration of all cameras of a stand."""

    version: Literal[1] = 1
    cameras: dict[str, CameraCalibration]
    overlap_rms: float | None
    """RMS difference between cameras for marks that several see (m); None: no mark is seen by two"""

    def placed(self) -> dict[str, PlacedCamera]:
        """Return the cameras with their poses."""
        return {name: _placed(found) for name, found in self.cameras.items()}


def middles(sightings: Sequence[Sighting]) -> dict[int, Array]:
    """Return the centre of each tag (pixels): the intersection of its diagonals, which perspective preserves."""
    return {sighting.tag: _crossing(sighting.corners) for sighting in sightings}


def seen_marks(pictures: Sequence[Picture]) -> dict[int, Array]:
    """Return the centres of tags, averaged over images of a still scene (pixels)."""
    found: dict[int, list[Array]] = {}
    for picture in pictures:
        for tag, middle in middles(TagReader(everywhere=1).read(picture)).items():
            found.setdefault(tag, []).append(middle)
    return {tag: np.mean(points, axis=0) for tag, points in found.items()}


def place(lens: Lens, seen: Mapping[int, Array], marks: Mapping[int, MarkConfig]) -> PlacedCamera:
    """Return the pose of one camera from marks at known places.

    Raises:
        InputError: there are too few of them are visible.
    """
    known = sorted(seen.keys() & marks.keys())
    if len(known) < LEAST_MARKS:
        raise InputError(f"the camera sees marks {known or 'none'}: expected {LEAST_MARKS} of {sorted(marks)}")
    points = np.array([(marks[tag].x, marks[tag].y, 0.0) for tag in known])
    pixels = np.array([seen[tag] for tag in known])
    _, rotation, translation = cv2.solvePnP(points, pixels, lens.matrix, lens.distortion, flags=cv2.SOLVEPNP_IPPE)
    rotation, translation = cv2.solvePnPRefineLM(points, pixels, lens.matrix, lens.distortion, rotation, translation)
    return PlacedCamera(lens, np.ravel(rotation), np.ravel(translation))


def check_places(
    placed: PlacedCamera, seen: Mapping[int, Array], marks: Mapping[int, MarkConfig], ruler: float
) -> None:
    """Reject a mark that is not at its given place.

    Args:
        placed: camera, placed by all of its marks.
        seen: centres of its marks (pixels).
        marks: marks by tag.
        ruler: standard deviation of a mark's position (m).

    Raises:
        InputError: a mark is elsewhere; the text names the mark whose removal makes the others fit, otherwise the three
            worst.
    """
    # maximum error of a mark's position, m, and in standard deviations of the ruler
    misplaced = (0.002, 5.0)
    limit = misplaced[0] + misplaced[1] * ruler

    def off(camera: PlacedCamera) -> dict[int, float]:
        points = {tag: camera.on_plane(px[None])[0] for tag, px in seen.items()}
        return {tag: float(np.hypot(*(points[tag] - (marks[tag].x, marks[tag].y)))) for tag in seen}

    def text(found: Mapping[int, float]) -> str:
        return ", ".join(f"marks.{tag} by {1000 * way:.0f} mm" for tag, way in found.items())

    now = off(placed)
    if max(now.values()) < limit:
        return
    if len(seen) > LEAST_MARKS:
        without = {tag: off(place(placed.lens, {t: px for t, px in seen.items() if t != tag}, marks)) for tag in seen}
        least, tag = min((max(way for t, way in rest.items() if t != tag), tag) for tag, rest in without.items())
        if least < limit:
            raise InputError(
                f"a mark is not at its configured place, {text({tag: without[tag][tag]})}: measure it again"
            )
    worst = dict(sorted(now.items(), key=lambda item: -item[1])[:3])
    raise InputError(f"marks are not at their configured places, {text(worst)}: measure them all again")


def join(
    cameras: Mapping[str, PlacedCamera],
    seen: Mapping[str, Mapping[int, Array]],
    marks: Mapping[int, MarkConfig],
    ruler: float,
) -> dict[str, PlacedCamera]:
    """Fit the poses of all cameras together, by the measured places of marks and their places in the other cameras.

    Args:
        cameras: cameras placed one by one.
        seen: centres of marks by camera (pixels).
        marks: marks by tag.
        ruler: standard deviation of a mark's position (m).
    """
    names = list(cameras)
    rays = {n: {tag: cameras[n].lens.directions(px[None])[0] for tag, px in seen[n].items()} for n in names}
    tags = sorted({tag for found in seen.values() for tag in found})
    start = np.concatenate([np.concatenate((cameras[n].rotation, cameras[n].translation)) for n in names])
    lists = {n: (list(rays[n]), np.array(list(rays[n].values()))) for n in names if rays[n]}

    def residual(parameters: Array) -> Array:
        by_tag: dict[int, list[Array]] = {tag: [] for tag in tags}
        for k, name in enumerate(names):
            if name not in lists:
                continue
            own = parameters[6 * k : 6 * k + 6]
            numbers, directions = lists[name]
            for tag, point in zip(numbers, meet(directions, rotation_matrix(own[:3]), own[3:]), strict=True):
                by_tag[tag].append(point)
        off: list[Array] = []
        for tag, points in by_tag.items():
            middle = np.mean(points, axis=0)
            # 0.0005: standard deviation of a point on the table by camera noise, m: a fifth of a pixel
            off += [(point - middle) / 0.0005 for point in points] if len(points) > 1 else []
            off.append((middle - (marks[tag].x, marks[tag].y)) / ruler)
        return np.concatenate(off)

    fit = least_squares(residual, start, start - 1.0, start + 1.0, iterations=30)
    return {
        name: PlacedCamera(cameras[name].lens, fit.parameters[6 * k : 6 * k + 3], fit.parameters[6 * k + 3 : 6 * k + 6])
        for k, name in enumerate(names)
    }


def calibrate(
    config: OverheadConfig, boards: Mapping[str, Sequence[Picture]], floors: Mapping[str, Sequence[Picture]]
) -> StandCalibration:
    """Calibrate lenses and poses, and join them.

    Args:
        config: configuration of the stand.
        boards: images of the board by camera.
        floors: images of the table by camera.

    Raises:
        InputError: a camera lacks images or marks, or a mark lies elsewhere; names it.
    """
    lenses: dict[str, tuple[LensFit, int]] = {}
    seen, placed = {}, {}
    for name in config.cameras:
        try:
            lenses[name] = lens_from_pictures(boards[name], BoardReader(config.board))
            # Other objects with a tag, such as a robot on the table, may be above its plane.
            seen[name] = {tag: px for tag, px in seen_marks(floors[name]).items() if tag in config.marks}
            placed[name] = place(lenses[name][0].lens, seen[name], config.marks)
            check_places(placed[name], seen[name], config.marks, config.ruler_error)
        except InputError as error:
            raise InputError(f"camera {name}: {error}") from error
    joined = join(placed, seen, config.marks, config.ruler_error)
    points = {name: {tag: joined[name].on_plane(px[None])[0] for tag, px in seen[name].items()} for name in joined}
    apart = [
        points[a][tag] - points[b][tag]
        for k, a in enumerate(joined)
        for b in list(joined)[k + 1 :]
        for tag in points[a].keys() & points[b].keys()
    ]
    found = {}
    for name, camera in joined.items():
        own = [points[name][tag] - (m.x, m.y) for tag, m in config.marks.items() if tag in points[name]]
        fit, count = lenses[name]
        found[name] = CameraCalibration(
            matrix=tuple(fit.lens.matrix.ravel().tolist()),
            distortion=tuple(fit.lens.distortion.tolist()),
            size=fit.lens.size,
            rotation=tuple(camera.rotation.tolist()),
            translation=tuple(camera.translation.tolist()),
            lens_rms=fit.rms,
            place_rms=_rms(own),
            boards=count,
            marks=len(own),
        )
    return StandCalibration(cameras=found, overlap_rms=_rms(apart) if apart else None)


def load(path: Path) -> StandCalibration:
    """Read the calibration file.

    Raises:
        ConfigError: it is missing or damaged.
    """
    expected = "a calibration of the stand (`stand calibrate` makes one)"
    with reading(path, expected, ConfigError):
        return StandCalibration.model_validate_json(contents(path, expected, MEGABYTE, ConfigError))


def save(calibration: StandCalibration, path: Path) -> None:
    """Write the calibration file atomically.

    Raises:
        ConfigError: the file cannot be written.
    """
    try:
        make_folder(path.parent)
        replace_file(path, calibration.model_dump_json(indent=1) + "\n")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error


def _placed(found: CameraCalibration) -> PlacedCamera:
    lens = Lens(np.array(found.matrix).reshape(3, 3), np.array(found.distortion), found.size)
    return PlacedCamera(lens, np.array(found.rotation), np.array(found.translation))


def _crossing(corners: Array) -> Array:
    a, b, c, d = corners
    (x1, y1), (x2, y2) = c - a, d - b
    dx, dy = b - a
    way = (dx * y2 - dy * x2) / (x1 * y2 - y1 * x2)
    return np.asarray(a + way * (c - a))


def _rms(points: Sequence[Array]) -> float:
    return float(np.sqrt(np.mean(np.sum(np.square(points), axis=1)))) if len(points) else 0.0
