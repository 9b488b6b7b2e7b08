"""Files of other programs: right values are read, and other files are refused by name.

One row for each format: producers (excerpts of published files, examples of documentation, and files written here by
another package), wrong values, and damaged files that are not refused by name. ``--lerobot PYTHON`` is an interpreter
with the package `lerobot-dataset`, which reads the exported data set. ``memory`` is the peak while reading a log of 200
MB, at its middle and at its end, and the extrapolation of its growth to 10 GB. The last line is JSON.

    python benchmarks/files.py [--lerobot PYTHON] [--no-memory]
"""

import argparse
import csv
import io
import json
import math
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import polars as pl
import pyarrow.parquet as pq
from ruamel.yaml import YAML

from benchmarks import ROOT
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.path_files import mission_from, path_from
from monstertruck_schemas import topics as t
from monstertruck_schemas.sensor import VALID_BEAM, LaserScan
from monstertruckd import open_log
from monstertruckd.tools.calibrate.lens_files import lens_from
from monstertruckd.tools.logs.arrow import export_parquet
from monstertruckd.tools.logs.lerobot import export_lerobot
from monstertruckd.tools.logs.pose_files import export_kitti, export_tum
from tests.unit.tools.logs.log_kit import Writer, odometry
from tests.unit.tools.logs.test_lerobot import write as write_drive

GOALS = {"producers": 3, "wrong": 0, "unnamed": 0, "memory_10gb_mb": 500.0}
"""Least number of producers; greatest other figures."""
RACELINE = "# s_m; x_m; y_m; psi_rad; kappa_radpm; vx_mps; ax_mps2"
POINTS = np.array([[0.0, 0.0], [1.0, 0.5], [2.0, 0.5], [3.0, 0.0]])
SPEEDS = np.array([3.0, 2.5, 2.0, 2.5])
DRIVE = {"x": [0.5, 1.5], "y": [0.25, -0.75], "yaw": [0.0, math.pi / 2]}

Example = tuple[str, str, Callable[[str], Any], Any]
"""Producer, text, reader, and what it is to give."""


def paths() -> dict[str, list[Example]]:
    """Racelines, centrelines and waypoints."""

    def points(text: str, name: str = "lap.csv", columns: tuple[str, ...] = ()) -> list[list[float]]:
        found = path_from(text, Path(name), closed=False, columns=columns)
        rows = found.poses.reshape(-1, 3)[:, :2]
        return np.column_stack((rows, found.speeds) if len(found.speeds) else (rows,)).tolist()

    raced = np.column_stack((np.arange(4), POINTS, np.zeros((4, 2)), SPEEDS, np.zeros(4)))
    with_speeds = np.column_stack((POINTS, SPEEDS)).tolist()
    saved, local, logged, listed = io.StringIO(), io.StringIO(), io.StringIO(), io.StringIO()
    for file in (saved, local):
        file.write("# 6a0b1c5e-3b1f-4f0e-9f50-d51a2c1d6d0e\n# da39a3ee5e6b4b0d3255bfef95601890afd80709\n")
    np.savetxt(saved, raced, "%.7f", "; ", header=RACELINE[2:])
    head = "x_ref_m; y_ref_m; width_right_m; width_left_m; x_normvec_m; y_normvec_m; alpha_m; s_racetraj_m; "
    head += "psi_racetraj_rad; kappa_racetraj_radpm; vx_racetraj_mps; ax_racetraj_mps2"
    beside = (np.ones((4, 2)), np.zeros(4), np.ones(4), np.full(4, 0.5), np.arange(4.0), np.zeros((4, 2)))
    shifted = np.column_stack((POINTS - (0.0, 0.5), *beside, SPEEDS, np.zeros(4)))
    np.savetxt(local, shifted, "%.7f", "; ", header=head)
    logged.write("#\n#\n" + RACELINE + "\n")
    pd.DataFrame(raced).to_csv(logged, sep=";", index=False, header=False, float_format="%.6f")
    writer = csv.writer(listed)
    writer.writerow(("s_m", "x_m", "y_m", "d_left", "d_right"))
    writer.writerows((k, *row, 1, 1) for k, row in enumerate(POINTS.tolist()))
    monza = (
        "# 26815e17\n# 603fd398\n# s_m; x_m; y_m; psi_rad; kappa_radpm; vx_mps; ax_mps2\n"
        "0.0000000;-0.6562914;0.1421486;1.5026776;-0.0035463;8.0000000;0.0000000\n"
        "0.1999859;-0.6426086;0.3416661;1.5019722;-0.0035075;8.0000000;0.0000000\n"
    )
    centre = "# x_m, y_m, w_tr_right_m, w_tr_left_m\n0.0, 0.0, 1.1, 1.1\n"
    centre += "0.03762573650077539, 0.38323937228042987, 1.1, 1.1\n"
    nodes = "".join(f"{x},{y},0.0,{v}\n" for (x, y), v in zip(POINTS.tolist(), SPEEDS.tolist(), strict=True))
    return {
        "f1tenth raceline": [
            ("f1tenth_racetracks, Monza", monza, points, [[-0.6562914, 0.1421486, 8], [-0.6426086, 0.3416661, 8]]),
            ("pandas, a node that logs a trajectory", logged.getvalue(), points, with_speeds),
            (
                "waypoint logger, no header",
                nodes,
                lambda text: points(text, columns=("x", "y", "yaw", "v")),
                with_speeds,
            ),
        ],
        "f1tenth centreline": [
            ("f1tenth_racetracks, Monza", centre, points, [[0, 0], [0.03762573650077539, 0.38323937228042987]]),
            ("csv module, columns d_left and d_right", listed.getvalue(), points, POINTS.tolist()),
            (
                "racetrack-database, tracks",
                "# x_m,y_m,w_tr_right_m,w_tr_left_m\n1,2,3,3\n2,2,3,3\n",
                points,
                [[1, 2], [2, 2]],
            ),
        ],
        "tum raceline": [
            ("numpy.savetxt, as global_racetrajectory_optimization", saved.getvalue(), points, with_speeds),
            ("numpy.savetxt, for the local planner", local.getvalue(), points, with_speeds),
            ("racetrack-database, racelines", "# x_m,y_m\n1.5,2\n2.5,2\n", points, [[1.5, 2], [2.5, 2]]),
        ],
    }


def waypoints() -> dict[str, list[Example]]:
    """Waypoints of Nav2 and of its users."""

    def steps(text: str) -> list[list[float]]:
        mission = mission_from(text, Path("way.yaml"))
        return [[getattr(step, name) for name in DRIVE] for step in mission.steps]

    def dumped(data: Any, **options: Any) -> str:
        yaml, text = YAML(typ="safe", pure=True), io.StringIO()
        for name, value in options.items():
            setattr(yaml, name, value)
        yaml.dump(data, text)
        return text.getvalue()

    rows = list(zip(*DRIVE.values(), strict=True))
    turns = [(math.cos(yaw / 2), math.sin(yaw / 2)) for *_, yaw in rows]
    panel = {
        f"waypoint{k}": {"pose": [x, y, 0.0], "orientation": [w, 0.0, 0.0, z]}
        for k, ((x, y, _), (w, z)) in enumerate(zip(rows, turns, strict=True))
    }
    poses = [
        {"position": {"x": x, "y": y, "z": 0.0}, "orientation": {"x": 0.0, "y": 0.0, "z": z, "w": w}}
        for (x, y, _), (w, z) in zip(rows, turns, strict=True)
    ]
    stamped = {
        "header": {"frame_id": "map"},
        "poses": [{"header": {"frame_id": "map"}, "pose": pose} for pose in poses],
    }
    pub = (
        "header:\n  seq: 0\n  stamp:\n    secs: 0\n    nsecs: 0\n  frame_id: ''\nposes:\n"
        "- position:\n    x: 2.0\n    y: 1.0\n    z: 1.0\n"
        "  orientation:\n    x: 0.0\n    y: 0.0\n    z: 0.0\n    w: 0.0\n"
    )
    values = [list(row) for row in rows]
    return {
        "nav2 waypoints": [
            ("Nav2's panel in RViz", dumped({"waypoints": panel}, default_flow_style=False), steps, values),
            (
                "list of x, y, yaw",
                dumped({"waypoints": [dict(zip(DRIVE, row, strict=True)) for row in rows]}),
                steps,
                values,
            ),
            ("nav_msgs/Path, ros2 topic echo", dumped(stamped) + "---\n", steps, values),
            ("PoseArray, rostopic pub", pub, steps, [[2, 1, 0]]),
        ]
    }


def lenses() -> dict[str, list[Example]]:
    """Camera intrinsics."""

    def numbers(text: str, **options: Any) -> list[float]:
        lens = lens_from(text, Path("camera.yaml"), **options)
        return [lens.focal_x, lens.focal_y, lens.centre_x, lens.centre_y, lens.k1, lens.k2, lens.p1, lens.p2, lens.k3]

    def ros(focal: str, brown: str, extra: str = "distortion_model: plumb_bob\n") -> str:
        return (
            f"image_width: 640\nimage_height: 480\ncamera_name: cam\n"
            f"camera_matrix:\n  rows: 3\n  cols: 3\n  data: [{focal}]\n"
            f"{extra}distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [{brown}]\n"
        )

    usb = (
        "568.19319, 0., 355.41726, 0., 565.76245, 166.62636, 0., 0., 1.",
        "-0.513007, 0.203746, -0.000107, 0.001255, 0.0",
    )
    meka = ("538.63, 0, 457.698, 0, 539.723, 297.003, 0, 0, 1", "-0.30678, 0.0825017, 0.0028784, -0.00015829, 0")
    webcam = (
        "%YAML:1.0\nimage_width: 640\nimage_height: 480\n"
        "camera_matrix:  !!opencv-matrix\n  rows: 3\n  cols: 3\n  dt: d\n"
        "  data: [722.937686, 0, 306.509634, 0, 726.001504, 263.802979, 0, 0, 1]\n"
        "distortion_coefficients:   !!opencv-matrix\n"
        "  rows: 1\n  cols: 5\n  dt: d \n  data: [0.109696, -0.556727, -0.001913, 0.000226, 0]\n"
    )
    kalibr = (
        "cam0:\n  camera_model: pinhole\n  intrinsics: [461.629, 460.152, 362.680, 246.049]\n"
        "  distortion_model: radtan\n"
        "  distortion_coeffs: [-0.27695497, 0.06712482, 0.00087538, 0.00011556]\n  resolution: [752, 480]\n"
        "  T_cam_imu:\n  - [1.0, 0.0, 0.0, 0.0]\n"
    )
    chain = [461.629, 460.152, 362.680, 246.049, -0.27695497, 0.06712482, 0.00087538, 0.00011556, 0.0]
    drone = (
        "cam0:\n  cam_overlaps: []\n  camera_model: pinhole\n"
        "  distortion_coeffs: [0.04674621, -0.05938970, -0.00057779, -0.00004768]\n  distortion_model: radtan\n"
        "  intrinsics: [389.6823, 391.3312, 309.0632, 260.3161]\n"
        "  resolution: [640, 480]\n  rostopic: /usb_cam/image_raw\n"
    )
    drone_cam = [389.6823, 391.3312, 309.0632, 260.3161, 0.04674621, -0.0593897, -0.00057779, -0.00004768, 0.0]
    astra = (
        "526.6908296825479, 0, 312.3333507245396, 0, 525.7542623070541, 246.2279496394374, 0, 0, 1",
        "0.01864117263397289, -0.0807953154457166, 0.0006701578887838996, -0.001800282263098739, 0",
    )
    astra_cam = [526.6908296825479, 525.7542623070541, 312.3333507245396, 246.2279496394374, 0.01864117263397289]
    astra_cam += [-0.0807953154457166, 0.0006701578887838996, -0.001800282263098739, 0]
    sample = (
        '%YAML:1.0\n---\ncalibration_time: "Thu Jan 30 14:43:57 2020"\nimage_width: 1920\nimage_height: 1080\n'
        "board_width: 4\nboard_height: 11\nflags: 0\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n"
        "   dt: d\n   data: [ 1.3704890781669139e+03, 0., 9.4620086455694741e+02, 0.,\n"
        "       1.3711542706267094e+03, 5.4099755744500317e+02, 0., 0., 1. ]\n"
        "distortion_coefficients: !!opencv-matrix\n   rows: 5\n   cols: 1\n   dt: d\n"
        "   data: [ 9.5598544598107946e-02, 1.5574125902392638e-01,\n       6.2864630028885743e-04,\n"
        "       -4.7488130423597530e-03, -8.3628840603895049e-01 ]\n"
    )
    sample_cam = [1370.4890781669139, 1371.1542706267094, 946.20086455694741, 540.99755744500317, 0.095598544598107946]
    sample_cam += [0.15574125902392638, 6.2864630028885743e-04, -4.7488130423597530e-03, -0.83628840603895049]
    echoed = (
        "height: 480\nwidth: 640\ndistortion_model: plumb_bob\nd: [0.1, 0.0, 0.0, 0.0, 0.0]\n"
        "k: [500.0, 0.0, 320.0, 0.0, 501.0, 240.0, 0.0, 0.0, 1.0]\n---\n"
    )

    vins = (
        "cam0:\n  cam_overlaps: []\n  camera_model: pinhole\n"
        "  distortion_coeffs: [-0.2879529995338575, 0.0781311194952221, 0.00021265916642721963,"
        " -0.0001221450347654466]\n"
        "  distortion_model: radtan\n"
        "  intrinsics: [458.9432286546919, 457.5637533402653, 367.0272509347057, 249.3128033381081]\n"
        "  resolution: [752, 480]\n  rostopic: /cam0/image_raw\n"
    )
    euroc = [458.9432286546919, 457.5637533402653, 367.0272509347057, 249.3128033381081]
    euroc += [-0.2879529995338575, 0.0781311194952221, 0.00021265916642721963, -0.0001221450347654466, 0.0]

    def stored(names: tuple[str, str]) -> str:
        storage = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
        storage.write(names[0], np.array([[500.0, 0, 320], [0, 501, 240], [0, 0, 1]]))
        storage.write(names[1], np.array([[0.1], [0.0], [0.0], [0.0], [0.0]]))
        return str(storage.releaseAndGetString())

    plain, size = [500.0, 501, 320, 240, 0.1, 0, 0, 0, 0], (640, 480)

    def sized(text: str) -> list[float]:
        return numbers(text, size=size)

    usb_cam = [568.19319, 565.76245, 355.41726, 166.62636, -0.513007, 0.203746, -0.000107, 0.001255, 0]
    mekabot = [538.63, 539.723, 457.698, 297.003, -0.30678, 0.0825017, 0.0028784, -0.00015829, 0]
    my_webcam = [722.937686, 726.001504, 306.509634, 263.802979, 0.109696, -0.556727, -0.001913, 0.000226, 0]
    return {
        "ros camera_info": [
            ("usb_cam", ros(*usb), numbers, usb_cam),
            ("mekabot, no model named", ros(*meka, ""), numbers, mekabot),
            ("camera_calibration, Astra", ros(*astra), numbers, astra_cam),
            ("ros2 topic echo", echoed, numbers, plain),
        ],
        "kalibr": [
            ("kalibr's wiki, camera chain", kalibr, numbers, chain),
            ("kalibr_calibrate_cameras, EuRoC", vins, numbers, euroc),
            ("kalibr_calibrate_cameras, a drone", drone, numbers, drone_cam),
        ],
        "opencv": [
            ("a webcam's file, !!opencv-matrix", webcam, numbers, my_webcam),
            ("OpenCV's calibration sample", sample, numbers, sample_cam),
            ("OpenCV, cameraMatrix and distCoeffs", stored(("cameraMatrix", "distCoeffs")), sized, plain),
            ("OpenCV, stereo sample M1 and D1", stored(("M1", "D1")), sized, plain),
        ],
    }


def judged(examples: list[Example]) -> dict[str, Any]:
    """Return the figures of a format; each example is damaged in five ways, and must be read or refused by name."""
    wrong, unnamed = [], 0
    for producer, text, read, expected in examples:
        try:
            same = np.allclose(np.asarray(read(text), float), np.asarray(expected, float), atol=1e-6)
        except (InputError, ValueError) as error:
            same = False
            print(f"  {producer}: {error}")
        if not same:
            wrong.append(producer)
        for damaged in (
            "",
            text[: len(text) // 2],
            text.replace("0", "x"),
            text.replace(":", "").replace(";", " "),
            "\0" + text,
        ):
            try:
                read(damaged)
            except InputError as error:
                unnamed += not str(error).startswith(("lap.csv", "way.yaml", "camera.yaml"))
            except Exception:  # noqa: BLE001 - any other failure is what is counted
                unnamed += 1
    return {"producers": len(examples), "wrong": len(wrong), "unnamed": unnamed, "which": wrong}


def logs(lerobot: str | None) -> dict[str, dict[str, Any]]:
    """Export logs and read them with other programs."""
    rows = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        log = write_drive(folder / "run.mcap")
        x = open_log(log).numpy("odometry", ["pose.x"])["pose.x"]
        file = export_parquet(log, folder / "tables")["state/odometry"]
        found = [pd.read_parquet(file)["pose.x"], pl.read_parquet(file)["pose.x"], pq.read_table(file)["pose.x"]]
        wrong = sum(not np.allclose(np.asarray(values), x) for values in found)
        rows["parquet, read by pandas, polars and pyarrow"] = {"producers": 3, "wrong": wrong, "unnamed": 0}
        for form, export, column in (("tum", export_tum, 1), ("kitti", export_kitti, 3)):
            file = export(log, folder / form)["state/odometry"]
            found = [
                np.loadtxt(file)[:, column],
                pd.read_csv(file, sep=" ", header=None)[column],
                pl.read_csv(file, separator=" ", has_header=False)[:, column],
            ]
            wrong = sum(not np.allclose(np.asarray(values, float), x) for values in found)
            rows[f"{form} poses, read by numpy, pandas and polars"] = {"producers": 3, "wrong": wrong, "unnamed": 0}
        export_lerobot(log, folder / "set")
        file = folder / "set/data/chunk-000/file-000.parquet"
        found = [
            pd.read_parquet(file)["action"][5],
            pl.read_parquet(file)["action"][5],
            pq.read_table(file)["action"][5].as_py(),
        ]
        wrong = sum(not np.allclose(np.asarray(values, float), [0.1, 0.05, -0.05]) for values in found)
        rows["lerobot rows, read by pandas, polars and pyarrow"] = {"producers": 3, "wrong": wrong, "unnamed": 0}
        read = "from ledataset.datasets.lerobot_dataset import LeRobotDataset as D\n" + (
            f"rows = D('local/drive', root={str(folder / 'set')!r}, video_backend='pyav')\n"
            "print(len(rows), *rows[5]['action'].tolist(), 255 * float(rows[5]['observation.images.camera'].mean()))\n"
        )
        if lerobot is not None:
            done = subprocess.run([lerobot, "-c", read], capture_output=True, text=True, check=False)
            values = [float(word) for word in done.stdout.split()] or [math.nan] * 5
            same = np.allclose(values, [30, 0.1, 0.05, -0.05, 40], atol=[0, 1e-6, 1e-6, 1e-6, 4])
            rows["lerobot data set and video, read by lerobot-dataset"] = {"wrong": int(not same), "unnamed": 0}
    return rows


SIZE = 200
"""Size of the log whose reading is measured, MB."""


def write_log(file: Path) -> None:
    """Write different scans of 1081 beams, and odometry."""
    ranges, writer, seq = np.random.default_rng(1).uniform(0.2, 9.0, 1081), Writer(file), 0
    scan: dict[str, Any] = {"start_angle": -2.0, "end_angle": 2.0, "time_increment": 1e-4, "scan_time": 0.1}
    scan |= {"range_min": 0.1, "range_max": 10.0, "codes": np.full(1081, VALID_BEAM, np.uint8)}
    while not file.exists() or file.stat().st_size < SIZE * 1e6:
        now = 10**9 + seq * 10**8
        for turn in range(5):
            writer.put(t.ODOMETRY, odometry(now + turn * 2 * 10**7, 5 * seq + turn))
        head = {"stamp": now, "received": now, "seq": seq, "ranges": np.roll(ranges, seq) * (1.0 + 1e-7 * seq)}
        writer.put(t.SCAN, LaserScan.model_validate(head | scan))
        seq += 1
    writer.log.finish()


def read_log(what: str, file: Path) -> None:
    """Read a log; print the peaks of this process's memory at its middle and at its end, MB."""
    half: list[float] = []

    def peak() -> float:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000

    def seen(position: float) -> None:
        if not half and position > SIZE * 0.5e6:
            half.append(peak())

    if what == "parquet":
        export_parquet(file, file.parent / "out", progress=seen)
    else:
        log = open_log(file)
        for table in log.frames("scan", "odometry", library="polars"):
            del table
            seen(log._reader.position)  # noqa: SLF001
    print(half[0], peak())


def memory() -> dict[str, dict[str, Any]]:
    """Return the peaks at the middle and end of a log, and the extrapolation to 10 GB; MB."""
    rows = {}
    with tempfile.TemporaryDirectory() as name:
        file = Path(name) / "run.mcap"
        write_log(file)
        for what in ("parquet", "frames"):
            words = [sys.executable, "-m", "benchmarks.files", "--read", what, str(file)]
            done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True)
            half, whole = map(float, done.stdout.split())
            growth = 2.0 * (whole - half) / SIZE
            row = {"mb_at_half": half, "mb_at_end": whole, "memory_10gb_mb": round(whole + growth * (10_000 - SIZE), 1)}
            rows[f"memory, {what}"] = row
    return rows


def main() -> int:
    """Measure and print; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--lerobot", help="interpreter with the package lerobot-dataset")
    parser.add_argument("--no-memory", action="store_true")
    parser.add_argument("--read", nargs=2, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.read:
        read_log(given.read[0], Path(given.read[1]))
        return 0
    rows = {name: judged(examples) for name, examples in (paths() | waypoints() | lenses()).items()}
    rows |= logs(given.lerobot)
    rows |= {} if given.no_memory else memory()
    for name, row in rows.items():
        print(f"{name:44}", "  ".join(f"{key} {value}" for key, value in row.items()), flush=True)
    met = all(
        row.get("producers", 3) >= GOALS["producers"]
        and row.get("wrong", 0) <= GOALS["wrong"]
        and row.get("unnamed", 0) <= GOALS["unnamed"]
        and row.get("memory_10gb_mb", 0.0) <= GOALS["memory_10gb_mb"]
        for row in rows.values()
    )
    print(json.dumps({"bench": "files", "figures": rows, "goals": GOALS, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
