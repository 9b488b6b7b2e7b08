"""Camera intrinsics files: ``camera_info`` of ROS, camera chains of kalibr, OpenCV matrices; pinhole and Brown models.

All formats measure pixel coordinates from the centre of the first pixel, as ``LensConfig`` does.
"""

import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from ruamel.yaml.error import YAMLError

from monstertruck_runtime.errors import InputError
from monstertruck_runtime.outside import quoted, reading, xml_from
from monstertruck_runtime.yaml_files import bounded_yaml, yaml_text
from monstertruck_schemas.body import LensConfig
from monstertruckd.tools.calibrate.lens_forms import LensForm

EXPECTED: Final = "camera intrinsics"
_PINHOLE: Final = ("plumb_bob", "rational_polynomial", "radtan", "none", "")
"""Names of the pinhole model with Brown's distortion; the additional terms of a rational model must be 0."""
_NUMBER: Final = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?")
_OPENCV: Final = (
    ("camera_matrix", "distortion_coefficients"),
    ("cameraMatrix", "distCoeffs"),
    ("K", "D"),
    ("M1", "D1"),
)
"""Names of matrix and coefficients in OpenCV's files and samples."""


def lens_from(text: str, file: Path, *, camera: str | None = None, size: tuple[int, int] | None = None) -> LensConfig:
    """Parse the text of a lens file.

    Args:
        text: text of the file.
        file: file name, for error messages.
        camera: name of the camera in a camera chain; None if the file contains only one.
        size: image width and height (px), if the file does not state them.

    Raises:
        InputError: the lens model is unsupported, or numbers are invalid; the message names the first mistake.
    """
    data = _data(text, file)
    with reading(file, EXPECTED):
        if chain := {key: value for key, value in data.items() if isinstance(value, dict) and "intrinsics" in value}:
            return _kalibr(_chosen(chain, camera, file), file)
        for matrix, coefficients in (*_OPENCV, ("k", "d")):
            if matrix in data:
                return _matrices(data, matrix, coefficients, file, size)
    raise InputError(f"{file}: expected {EXPECTED}: a camera_matrix (ROS, OpenCV), k and d, or intrinsics (kalibr)")


def lens_text(lens: LensConfig, form: LensForm, name: str = "camera") -> str:
    """Format a lens as the text of a file.

    Args:
        lens: lens to write.
        form: file format.
        name: camera name.
    """
    focal = (lens.focal_x, lens.focal_y, lens.centre_x, lens.centre_y)
    matrix = [lens.focal_x, 0.0, lens.centre_x, 0.0, lens.focal_y, lens.centre_y, 0.0, 0.0, 1.0]
    brown = [lens.k1, lens.k2, lens.p1, lens.p2, lens.k3]
    match form:
        case LensForm.CONFIG:
            return yaml_text({"lens": lens.model_dump(mode="json")})
        case LensForm.ROS:
            eye = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
            projection = [*matrix[:3], 0.0, *matrix[3:6], 0.0, *matrix[6:], 0.0]
            return yaml_text(
                {
                    "image_width": lens.width,
                    "image_height": lens.height,
                    "camera_name": name,
                    "camera_matrix": _rows(3, 3, matrix),
                    "distortion_model": "plumb_bob",
                    "distortion_coefficients": _rows(1, 5, brown),
                    "rectification_matrix": _rows(3, 3, eye),
                    "projection_matrix": _rows(3, 4, projection),
                }
            )
        case LensForm.KALIBR:
            if lens.k3:
                raise InputError(f"k3 {lens.k3:g}: kalibr's radtan model has only k1, k2, p1 and p2")
            row = {"camera_model": "pinhole", "intrinsics": list(focal), "distortion_model": "radtan"}
            return yaml_text({"cam0": row | {"distortion_coeffs": brown[:4], "resolution": [lens.width, lens.height]}})
        case LensForm.OPENCV:
            head = f"%YAML:1.0\n---\nimage_width: {lens.width}\nimage_height: {lens.height}\n"
            return head + _opencv("camera_matrix", 3, 3, matrix) + _opencv("distortion_coefficients", 1, 5, brown)


def _rows(rows: int, columns: int, data: list[float]) -> dict[str, Any]:
    return {"rows": rows, "cols": columns, "data": data}


def _opencv(name: str, rows: int, columns: int, data: list[float]) -> str:
    numbers = ", ".join(f"{value!r}" for value in data)
    return f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {numbers} ]\n"


def _data(text: str, file: Path) -> Mapping[str, Any]:
    """Mapping in a YAML file, or in an OpenCV file: XML, JSON, or YAML whose first line and tags are not valid YAML."""
    if text.lstrip("\ufeff \r\n").startswith("<"):
        return _storage(xml_from(text, file, EXPECTED), file)
    plain = re.sub(r"!!opencv-matrix\b", "", re.sub(r"\A\ufeff?%YAML[^\n]*\n(---[^\n]*\n)?", "", text))
    documents = [part for part in plain.split("\n---") if part.strip("- \n")]
    with reading(file, EXPECTED):
        try:
            data = bounded_yaml().load(documents[0]) if documents else None
        except YAMLError as error:
            cause = quoted(str(error))
            raise InputError(f"{file}: expected {EXPECTED}: not valid YAML: {cause}") from error
    if not isinstance(data, dict):
        raise InputError(f"{file}: expected {EXPECTED}: a mapping")
    return data


def _storage(root: ET.Element, file: Path) -> dict[str, Any]:
    """Values of an OpenCV storage in XML: matrices and plain values by name."""
    if root.tag != "opencv_storage":
        raise InputError(f"{file}: expected {EXPECTED}: an element opencv_storage, found {root.tag}")
    found: dict[str, Any] = {}
    for element in root:
        if element.get("type_id") == "opencv-matrix":
            words = (element.findtext("data") or "").split()
            found[element.tag] = {"data": [float(word) if _NUMBER.fullmatch(word) else word for word in words]}
        else:
            text = (element.text or "").strip()
            found[element.tag] = int(text) if re.fullmatch(r"[0-9]{1,9}", text) else text
    return found


def _chosen(chain: Mapping[str, Any], camera: str | None, file: Path) -> Mapping[str, Any]:
    if camera is None and len(chain) > 1:
        raise InputError(f"{file}: contains {', '.join(chain)}: choose one with --camera")
    if camera is not None and camera not in chain:
        raise InputError(f"{file}: no camera {camera}: expected one of {', '.join(chain)}")
    found: Mapping[str, Any] = chain[camera or next(iter(chain))]
    return found


def _kalibr(row: Mapping[str, Any], file: Path) -> LensConfig:
    if row.get("camera_model") != "pinhole":
        raise InputError(f"{file}: camera_model {row.get('camera_model')}: expected pinhole")
    numbers = _floats(row["intrinsics"], 4, "intrinsics", file)
    return _lens(
        numbers, row.get("distortion_coeffs", ()), str(row.get("distortion_model", "")), row.get("resolution"), file
    )


def _matrices(
    data: Mapping[str, Any], matrix: str, coefficients: str, file: Path, size: tuple[int, int] | None
) -> LensConfig:
    """Intrinsics in ROS or OpenCV format: a matrix of nine numbers, and the distortion coefficients."""
    numbers = _floats(_numbers(data[matrix]), 9, matrix, file)
    fx, skew, cx, a, fy, cy, b, c, one = numbers
    if (skew, a, b, c, one) != (0.0, 0.0, 0.0, 0.0, 1.0):
        raise InputError(f"{file}: {matrix}: expected a matrix without skew, its last row 0, 0, 1")
    width = data.get("image_width", data.get("width", size and size[0]))
    height = data.get("image_height", data.get("height", size and size[1]))
    model = str(data.get("distortion_model", data.get("camera_model", "")))
    return _lens((fx, fy, cx, cy), _numbers(data.get(coefficients, ())), model, (width, height), file)


def _numbers(value: Any) -> Any:
    return value.get("data") if isinstance(value, dict) else value


def _floats(values: Any, count: int, name: str, file: Path) -> list[float]:
    with reading(f"{file}: {name}", f"{count} numbers"):
        numbers = np.ravel(np.asarray(values, np.float64)).tolist()
    if len(numbers) != count:
        raise InputError(f"{file}: {name}: expected {count} numbers, found {len(numbers)}")
    return [float(value) for value in numbers]


def _lens(focal: Sequence[float], coefficients: Any, model: str, size: Any, file: Path) -> LensConfig:
    if model not in _PINHOLE:
        raise InputError(f"{file}: distortion_model {model}: expected plumb_bob or radtan")
    brown = np.ravel(np.asarray(coefficients, np.float64)).tolist()
    if np.any(brown[5:]):
        raise InputError(f"{file}: {len(brown)} distortion coefficients: expected k1, k2, p1, p2, k3 and zeros")
    if not isinstance(size, Sequence) or len(size) != 2 or None in size:
        raise InputError(f"{file}: contains no image size: state it with --size WIDTHxHEIGHT")
    k1, k2, p1, p2, k3 = (brown + [0.0] * 5)[:5]
    fx, fy, cx, cy = focal
    with reading(file, EXPECTED):
        return LensConfig.model_validate(
            {
                "width": size[0], "height": size[1], "focal_x": fx, "focal_y": fy, "centre_x": cx, "centre_y": cy,
                "k1": k1, "k2": k2, "k3": k3, "p1": p1, "p2": p2,
            }
        )  # fmt: skip
