"""Path files: our table format, racelines and centrelines of F1TENTH and TUM, waypoints of Nav2, paths of ROS.

Points are in metres. Headings of racelines are not read, because TUM measures them from the y axis and F1TENTH from the
x axis, under the same name (``psi_rad``). The direction of the path replaces them.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path as FilePath
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from ruamel.yaml.error import YAMLError

from monstertruck_runtime.errors import InputError
from monstertruck_runtime.outside import quoted, reading
from monstertruck_runtime.path_forms import PathForm
from monstertruck_runtime.tables import COMMENT, cells_of, delimiter_of, rows_of
from monstertruck_runtime.yaml_files import bounded_yaml, yaml_text
from monstertruck_schemas.mission import Mission
from monstertruck_schemas.plan import MAX_POSES, Path

Array = NDArray[np.float64]

HEADER: Final = ("x", "y", "yaw", "direction")
"""Columns of our table format; ``speed`` may follow."""
COLUMNS: Final[Mapping[str, tuple[str, ...]]] = {
    "x": ("x", "x_m"),
    "y": ("y", "y_m"),
    "speed": ("speed", "speed_mps", "v", "v_mps", "vx", "vx_mps", "vx_racetraj_mps", "velocity"),
}
"""Names of a column in the formats of other programs."""
_UNIT: Final = re.compile(r"(\w+)\s*[\[(]\s*(.*?)\s*[\])]")
"""A column's name with its unit in brackets."""
_UNITS: Final[Mapping[str, str]] = {
    **dict.fromkeys((*COLUMNS["x"], *COLUMNS["y"]), "m"),
    "yaw": "rad",
    "direction": "1",
    **dict.fromkeys(COLUMNS["speed"], "m/s"),
}
"""Units of the columns that are read."""
_SHIFTED: Final = ("x_ref_m", "y_ref_m", "x_normvec_m", "y_normvec_m", "alpha_m")
"""TUM's trajectory for a local planner: reference line, its normals, and the shift along them."""
EXPECTED: Final = "a path"
LARGEST_PATH_FILE: Final = 10_000_000
"""Maximum size of a file of poses: more than a hundred thousand."""
SPACING: Final = 0.05
"""Distance between the poses of a curve through waypoints, m."""


def names_of(columns: str | None) -> tuple[str, ...]:
    """Split a comma-separated list of names."""
    return tuple(columns.split(",")) if columns else ()


def path_from(text: str, file: FilePath, *, closed: bool, frame: str = "odom", columns: Sequence[str] = ()) -> Path:
    """Parse a path; whether the robot can track it is not checked.

    Args:
        text: text of the file.
        file: file name; its suffix distinguishes table and YAML (or JSON).
        closed: whether the path is a lap.
        frame: frame of its poses.
        columns: column names of a table, which replace those in the file.

    Raises:
        InputError: invalid content; the message names file, line and expected content.
    """
    if _is_yaml(file):
        rows, curved = _waypoints(text, file)
        poses = _through(rows, closed=closed) if curved else rows
        directions, speeds = np.ones(len(poses)), np.zeros(0)
    else:
        poses, directions, speeds = _table(text, file, columns, closed=closed)
    if len(poses) < 2:
        raise InputError(f"{file}: expected at least two poses, found {len(poses)}")
    return Path(
        stamp=0,
        received=0,
        seq=0,
        frame=frame,
        poses=poses.ravel(),
        directions=directions,
        speeds=speeds,
        closed=closed,
        name=file.stem,
    )


def has_waypoints(text: str) -> bool:
    """Return whether a YAML file's text has waypoints or the poses of a path."""
    return re.search(r"^(waypoints|poses)\s*:", text, re.MULTILINE) is not None


def mission_from(text: str, file: FilePath) -> Mission:
    """Return a mission that drives to each waypoint of a file.

    Raises:
        InputError: it contains no waypoints, more than a mission may have, or other content; the message names the
            first error.
    """
    poses, _ = _waypoints(text, file)
    steps = [{"do": "goto", "x": x, "y": y, "yaw": yaw} for x, y, yaw in poses.tolist()]
    name = re.sub(r"[^a-z0-9_]", "_", file.stem.lower())
    with reading(file, "waypoints of a mission"):
        return Mission.model_validate({"version": 2, "name": name, "steps": steps})


def path_text(path: Path, form: PathForm, *, speed: float | None = None, width: float | None = None) -> str:
    """Format a path as the text of a file.

    Args:
        path: path to write.
        form: file format.
        speed: speed for a raceline if the path has no speeds, m/s.
        width: free width on each side of a centreline, m.

    Raises:
        InputError: the format needs a speed or width, or does not support backward motion.
    """
    poses = path.poses.reshape(-1, 3)
    directions = path.directions if len(path.directions) else np.ones(len(poses))
    if form is PathForm.CSV:
        columns = [*poses.T, directions, *([path.speeds] if len(path.speeds) else [])]
        names = [*HEADER, *(["speed"] if len(path.speeds) else [])]
        return _lines(",".join(names), columns, ",")
    if (directions < 0).any():
        raise InputError(f"path {path.name}: drives backward, which the form {form} cannot hold: expected csv")
    if form is PathForm.NAV2:
        return yaml_text({"waypoints": {f"waypoint{i}": _waypoint(*pose) for i, pose in enumerate(poses.tolist())}})
    if form is PathForm.CENTRELINE:
        if width is None:
            raise InputError("a centreline needs the width of the track on each side")
        sides = np.full(len(poses), width)
        return _lines("# x_m, y_m, w_tr_right_m, w_tr_left_m", [*poses.T[:2], sides, sides], ", ")
    if not len(path.speeds) and speed is None:
        raise InputError(f"path {path.name}: has no speeds, which a raceline needs")
    speeds = path.speeds if len(path.speeds) else np.full(len(poses), float(speed or 0.0))
    s = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))))
    heading = np.unwrap(_headings(poses[:, :2], closed=path.closed))
    if len(np.unique(s)) < len(s):
        raise InputError(f"path {path.name}: repeats a point, which a raceline cannot hold")
    psi = np.remainder(heading - (math.pi / 2 if form is PathForm.TUM else 0.0) + math.pi, math.tau) - math.pi
    columns = [s, *poses.T[:2], psi, np.gradient(heading, s), speeds, 0.5 * np.gradient(speeds**2, s)]
    return _lines("# s_m; x_m; y_m; psi_rad; kappa_radpm; vx_mps; ax_mps2", columns, ";")


def _lines(head: str, columns: Sequence[Array], delimiter: str) -> str:
    rows = (delimiter.join(f"{value:.7f}" for value in row) for row in np.column_stack(columns).tolist())
    return "\n".join((head, *rows, ""))


def _waypoint(x: float, y: float, yaw: float) -> dict[str, list[float]]:
    """Return a pose in the format of Nav2's RViz panel: position, and quaternion w, x, y, z."""
    return {"pose": [x, y, 0.0], "orientation": [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]}


def _is_yaml(file: FilePath) -> bool:
    return file.suffix.lower() in (".yaml", ".yml", ".json")


# Tables


def _table(text: str, file: FilePath, columns: Sequence[str], *, closed: bool) -> tuple[Array, Array, Array]:
    """Return poses, directions and speeds (or none) of a table."""
    rows = rows_of(text, file, EXPECTED)
    if not rows:
        raise InputError(f"{file}: expected {EXPECTED}: the file is empty")
    given, start = _names(text, file, rows, columns)
    names = [_plain(name, file, rows[0][0]) for name in given]
    for name in names:
        if name and names.count(name) > 1:
            raise InputError(f"{file}:{rows[0][0]}: expected one column {name}, found {names.count(name)}")
    numbers = np.array([_numbers(file, line, cells, names) for line, cells in rows[start:]]).reshape(-1, len(names))
    found = dict(zip(names, numbers.T, strict=True))
    speeds = next((found[name] for name in COLUMNS["speed"] if name in found), np.zeros(0))
    _require(speeds >= 0.0, "a speed of zero or more", file, rows[start:])
    if found.keys() >= set(HEADER):
        _require(np.abs(found["direction"]) == 1.0, "a direction of 1 or -1", file, rows[start:])
        return np.column_stack([found[name] for name in HEADER[:3]]), found["direction"], speeds
    if all(name in found for name in _SHIFTED):
        x, y, nx, ny, shift = (found[name] for name in _SHIFTED)
        points = np.column_stack((x + shift * nx, y + shift * ny))
    else:
        points = np.column_stack([_column(file, rows, found, name) for name in ("x", "y")])
    if len(points) < 2:
        return np.zeros((len(points), 3)), np.ones(len(points)), speeds
    return np.column_stack((points, _headings(points, closed=closed))), np.ones(len(points)), speeds


def _require(right: NDArray[np.bool_], what: str, file: FilePath, rows: list[tuple[int, list[str]]]) -> None:
    """Raise an error for the first invalid row."""
    if not right.all():
        line, cells = rows[int(np.argmin(right))]
        raise InputError(f"{file}:{line}: expected {what}, found {quoted(','.join(cells))}")


def _column(file: FilePath, rows: list[tuple[int, list[str]]], found: Mapping[str, Array], name: str) -> Array:
    for other in COLUMNS[name]:
        if other in found:
            return found[other]
    given = quoted(",".join(found))
    raise InputError(
        f"{file}:{rows[0][0]}: expected columns {','.join(HEADER)}, or x_m and y_m with vx_mps where there are speeds, "
        f"named in a header or by --columns; found {given}"
    )


def _names(
    text: str, file: FilePath, rows: list[tuple[int, list[str]]], columns: Sequence[str]
) -> tuple[list[str], int]:
    """Return the column names, and the number of rows they occupy.

    The names come from the caller, the first row, or the last comment before it.
    """
    first, cells = rows[0]
    if columns:
        return [name.strip().lower() for name in columns], 0 if _is_number(cells[0]) else 1
    if not _is_number(cells[0]):
        return [cell.lower() for cell in cells], 1
    before = text.removeprefix("\ufeff").splitlines()[: first - 1]
    for number, line in reversed([*enumerate(before, start=1)]):
        comment = _UNIT.sub(r"\1[\2]", line.strip().lstrip(COMMENT))
        names = [name.lower() for name in cells_of(comment, delimiter_of(comment))]
        if not line.strip().startswith(COMMENT):
            continue
        if len(names) == len(cells):
            return names, 0
        if names and all(_bare(name) in _UNITS for name in names):
            raise InputError(f"{file}:{number}: names {len(names)} columns: expected {len(cells)}, as in line {first}")
    return ["x", "y"] if len(cells) == 2 else [f"column {i + 1}" for i in range(len(cells))], 0


def _bare(name: str) -> str:
    """Return a column's name without its unit: ``x`` for ``x [m]``."""
    found = _UNIT.fullmatch(name)
    return found[1] if found else name


def _plain(name: str, file: FilePath, line: int) -> str:
    """Return the bare name of a column that is read, and any other name unchanged; reject a wrong unit."""
    found = _UNIT.fullmatch(name)
    if found is None or found[1] not in _UNITS:
        return name
    if found[2] != _UNITS[found[1]]:
        raise InputError(f"{file}:{line}: column {name}: expected the unit {_UNITS[found[1]]}")
    return found[1]


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _numbers(file: FilePath, line: int, cells: list[str], names: Sequence[str]) -> list[float]:
    try:
        numbers = [float(cell) for cell in cells]
    except ValueError as error:
        raise InputError(f"{file}:{line}: expected numbers, found {quoted(','.join(cells))}") from error
    if len(numbers) != len(names) or not all(map(math.isfinite, numbers)):
        given = quoted(",".join(cells))
        raise InputError(f"{file}:{line}: expected {len(names)} finite numbers ({','.join(names)}), found {given}")
    return numbers


def _headings(points: Array, *, closed: bool) -> Array:
    """Return the direction of the path at each point, shape (n,), rad."""
    if closed:
        points = np.concatenate((points[-1:], points, points[:1]))
    way = np.gradient(points, axis=0)
    headings: Array = np.arctan2(way[:, 1], way[:, 0])
    return headings[1:-1] if closed else headings


# Waypoints


def _waypoints(text: str, file: FilePath) -> tuple[Array, bool]:
    """Poses in a YAML file, and whether they are waypoints (far apart) rather than a path."""
    # `ros2 topic echo` ends each message with a line of dashes.
    documents = [part for part in text.removeprefix("\ufeff").split("\n---") if part.strip("- \n")]
    with reading(file, "waypoints"):
        try:
            data = bounded_yaml(200_000).load(documents[0]) if documents else None  # keys and values: 9000 poses
        except YAMLError as error:
            raise InputError(f"{file}: expected waypoints: not valid YAML: {quoted(str(error))}") from error
        if not isinstance(data, dict) or not ("waypoints" in data or "poses" in data):
            raise InputError(f"{file}: expected a mapping with waypoints, or with the poses of a path")
        name = "waypoints" if "waypoints" in data else "poses"
        frame = data.get("frame_id") or _mapping(data.get("header")).get("frame_id") or "map"
        if frame not in ("map", "odom"):
            raise InputError(f"{file}: frame {frame!r}: expected map or odom")
        rows = data[name].items() if isinstance(data[name], dict) else enumerate(data[name] or ())
        poses = np.array([_pose(row, f"{file}: {name} {key}") for key, row in rows]).reshape(-1, 3)
    if not len(poses):
        raise InputError(f"{file}: expected at least one pose under {name}")
    return poses, name == "waypoints"


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, dict) else {}


def _pose(row: Any, where: str) -> tuple[float, float, float]:
    """Parse a waypoint in any of the supported forms."""
    row = _mapping(row)
    if "latitude" in row:
        raise InputError(f"{where}: has a latitude: expected metres in the map")
    if isinstance(row.get("pose"), list):  # Nav2's panel in RViz: x, y, z and quaternion w, x, y, z
        (x, y), turn = row["pose"][:2], _quadruple(row.get("orientation"), where)
        return _finite(where, x, y, _yaw(*turn))
    row = _mapping(row.get("pose", row))
    place = _mapping(row.get("position", row))
    if "x" not in place or "y" not in place:
        raise InputError(f"{where}: expected x and y, position, or pose")
    if isinstance(turn := row.get("orientation"), dict):
        return _finite(where, place["x"], place["y"], _yaw(*(turn.get(axis, 0.0) for axis in "wxyz")))
    yaw = next((place[name] for name in ("yaw", "theta") if name in place), None)
    if yaw is None:
        raise InputError(f"{where}: expected a yaw (rad) or an orientation")
    if isinstance(yaw, int | float) and math.isfinite(yaw) and abs(yaw) > math.tau:
        raise InputError(f"{where}: yaw {yaw:g}: expected radians from -2 pi to 2 pi")
    return _finite(where, place["x"], place["y"], yaw)


def _quadruple(values: Any, where: str) -> Iterable[float]:
    if not isinstance(values, list) or len(values) != 4:
        raise InputError(f"{where}: expected an orientation of four numbers: w, x, y, z")
    return values


def _yaw(w: float, x: float, y: float, z: float) -> float:
    return math.atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)


def _finite(where: str, *values: Any) -> tuple[float, float, float]:
    if not all(isinstance(value, int | float) and math.isfinite(value) for value in values):
        raise InputError(f"{where}: expected finite numbers, found {quoted(', '.join(map(repr, values)))}")
    x, y, yaw = (float(value) for value in values)
    return x, y, yaw


def _through(poses: Array, *, closed: bool) -> Array:
    """Return a curve through waypoints and their headings, shape (m, 3): cubic in each gap, a pose every ``SPACING`` m.

    Raises:
        InputError: it is too long.
    """
    ends = np.concatenate((poses, poses[:1])) if closed else poses
    chords = np.hypot(*np.diff(ends[:, :2], axis=0).T)
    counts = np.maximum(np.ceil(np.minimum(chords, MAX_POSES) / SPACING).astype(int), 1)
    if counts.sum() > MAX_POSES:
        raise InputError(f"waypoints {chords.sum():.4g} m apart in all: expected at most {MAX_POSES * SPACING:g} m")
    points, ways = [], []
    for begin, end, chord, count in zip(ends[:-1], ends[1:], chords, counts, strict=True):
        u = np.arange(count)[:, None] / count
        begins, finishes = (chord * np.array([np.cos(pose[2]), np.sin(pose[2])]) for pose in (begin, end))
        points.append(
            (1 + 2 * u) * (1 - u) ** 2 * begin[:2] + u * (1 - u) ** 2 * begins
            + u**2 * (3 - 2 * u) * end[:2] - u**2 * (1 - u) * finishes
        )  # fmt: skip
        ways.append(
            6 * u * (1 - u) * (end[:2] - begin[:2]) + (1 - u) * (1 - 3 * u) * begins - u * (2 - 3 * u) * finishes
        )
    if not points:
        return poses
    way = np.concatenate(ways)
    curve = np.column_stack((np.concatenate(points), np.arctan2(way[:, 1], way[:, 0])))
    return curve if closed else np.concatenate((curve, poses[-1:]))
