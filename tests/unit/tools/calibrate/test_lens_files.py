"""Camera intrinsics of others: in, out, and what is refused."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from monstertruck_runtime.errors import InputError
from monstertruck_schemas.body import LensConfig
from monstertruckd.tools.calibrate.lens_files import lens_from, lens_text
from monstertruckd.tools.calibrate.lens_forms import LensForm

LENS = LensConfig(
    width=800, height=600, focal_x=610.5, focal_y=612.25, centre_x=401.5, centre_y=298.75, k1=-0.3, k2=0.1, p1=1e-3,
    p2=-2e-3,
)  # fmt: skip
ECHOED = """\
header: {stamp: {sec: 1, nanosec: 2}, frame_id: camera}
height: 600
width: 800
distortion_model: plumb_bob
d: [-0.3, 0.1, 0.001, -0.002, 0.0]
k: [610.5, 0.0, 401.5, 0.0, 612.25, 298.75, 0.0, 0.0, 1.0]
---
"""
KALIBR = """\
cam0:
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs: [-0.3, 0.1, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [610.5, 612.25, 401.5, 298.75]
  resolution: [800, 600]
  rostopic: /camera/image_raw
"""


def read(text: str, **options: object) -> LensConfig:
    return lens_from(text, Path("lens.yaml"), **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("text", [ECHOED, KALIBR, *(lens_text(LENS, form) for form in LensForm if form != "config")])
def test_each_form_is_the_same_lens(text: str):
    assert read(text) == LENS


@pytest.mark.parametrize("ending", ["yml", "xml", "json"])
def test_a_lens_in_each_of_opencvs_file_formats_is_read(tmp_path: Path, ending: str):
    file = tmp_path / f"cv.{ending}"
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Tue 01 Dec 2026")
    storage.write("image_width", 800)
    storage.write("image_height", 600)
    storage.write("camera_matrix", np.array([[610.5, 0, 401.5], [0, 612.25, 298.75], [0, 0, 1]]))
    storage.write("distortion_coefficients", np.array([[-0.3, 0.1, 1e-3, -2e-3, 0.0]]))
    storage.release()
    assert lens_from(file.read_text(), file) == LENS


@pytest.mark.parametrize(
    ("text", "refusal"),
    [
        ("<robot/>", "an element opencv_storage, found robot"),
        ("<opencv_storage><camera_matrix>", "no element found"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><opencv_storage/>', "declares entities"),
        ('<opencv_storage><K type_id="opencv-matrix"><data>1 a</data></K></opencv_storage>', "K: expected 9 numbers"),
    ],
)
def test_another_xml_file_is_refused(text: str, refusal: str):
    with pytest.raises(InputError, match=refusal):
        read(text)


def test_what_opencv_writes_is_read_and_what_we_write_is_read_by_opencv(tmp_path: Path):
    storage = cv2.FileStorage(str(tmp_path / "cv.yml"), cv2.FILE_STORAGE_WRITE)
    matrix = np.array([[610.5, 0, 401.5], [0, 612.25, 298.75], [0, 0, 1]])
    storage.write("cameraMatrix", matrix)
    storage.write("distCoeffs", np.array([[-0.3, 0.1, 1e-3, -2e-3, 0.0]]))
    storage.release()
    text = (tmp_path / "cv.yml").read_text()
    assert read(text, size=(800, 600)) == LENS
    with pytest.raises(InputError, match="contains no image size: state it with --size"):
        read(text)
    (tmp_path / "ours.yml").write_text(lens_text(LENS, LensForm.OPENCV))
    storage = cv2.FileStorage(str(tmp_path / "ours.yml"), cv2.FILE_STORAGE_READ)
    assert storage.getNode("camera_matrix").mat().tolist() == matrix.tolist()
    assert storage.getNode("distortion_coefficients").mat().tolist() == [[-0.3, 0.1, 1e-3, -2e-3, 0.0]]
    assert storage.getNode("image_width").real() == 800


def test_one_camera_of_a_chain_is_chosen():
    chain = KALIBR + KALIBR.replace("cam0", "cam1").replace("610.5", "500.0")
    assert read(chain, camera="cam1").focal_x == 500.0
    with pytest.raises(InputError, match="contains cam0, cam1: choose one with --camera"):
        read(chain)
    with pytest.raises(InputError, match="no camera cam7: expected one of cam0, cam1"):
        read(chain, camera="cam7")


@pytest.mark.parametrize(
    ("text", "refusal"),
    [
        (KALIBR.replace("pinhole", "omni"), "camera_model omni: expected pinhole"),
        (KALIBR.replace("radtan", "equidistant"), "distortion_model equidistant: expected plumb_bob or radtan"),
        (KALIBR.replace("610.5, ", ""), "intrinsics: expected 4 numbers, found 3"),
        (KALIBR.replace("610.5", "-1"), "focal_x: Input should be greater than 10"),
        (KALIBR.replace("610.5", ".nan"), "focal_x"),
        (ECHOED.replace("610.5, 0.0", "610.5, 0.2"), "expected a matrix without skew"),
        (ECHOED.replace("0.0]\nk", "0.0, 0.1]\nk"), "6 distortion coefficients"),
        ("a: 1\n", "expected camera intrinsics: a camera_matrix"),
        ("- 1\n", "expected camera intrinsics: a mapping"),
        ("a: [\n", "not valid YAML"),
        (ECHOED.replace("[610.5", "[a"), "k: expected 9 numbers"),
    ],
)
def test_other_lenses_are_refused_by_name(text: str, refusal: str):
    with pytest.raises(InputError, match=rf"lens\.yaml: .*{refusal}"):
        read(text)


def test_kalibrs_model_has_no_sixth_order():
    with pytest.raises(InputError, match="kalibr's radtan model has only k1, k2, p1 and p2"):
        lens_text(LENS.model_copy(update={"k3": 0.1}), LensForm.KALIBR)
