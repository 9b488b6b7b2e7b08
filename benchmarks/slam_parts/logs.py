"""The logs: origin, verification by checksum, and evaluation."""

import gzip
import hashlib
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.slam_parts import drawn
from monstertruck_estimation.slam.scans import ScanGeometry
from monstertruck_kinematics.se2 import between, interpolate
from monstertruck_runtime.clock import SECOND

MANIFEST = {
    "intel.npz": (
        "e977f113cec3be59a3dc0c5c5bad0d73bfb6353ca5b410b166f36cc7491f9675",
        "Intel Research Lab, Dirk Haehnel; joined from evlgroup/SOT, tipaldi/flirtlib, xiaofeng419/SLAM-2D-LIDAR-SCAN",
    ),
    "intel.relations.gz": (
        "a88d0b76f4f6f76b119c4623ef2f5b6e773d4ab9080e973a09914dd528af8dc9",
        "relations of Kuemmerle et al. 2009, from xiaofeng419/SLAM-2D-LIDAR-SCAN",
    ),
    "aces.npz": (
        "2d389044f17783814d80e518b38a7908d7ad7bf15375fd5cdb39cdab78e6977b",
        "ACES3 Austin, Patrick Beeson; from acschaefer/ple",
    ),
    "csail.npz": (
        "1a8cb694758e9f6616b4ea8c74e674cfb6d953a186aaa35490697e2d6ba9bf51",
        "MIT CSAIL, Cyrill Stachniss; from tipaldi/flirtlib, xiaofeng419/SLAM-2D-LIDAR-SCAN",
    ),
    "urg04lx_exp2.dat.gz": (
        "0ab6bad4c2b37929da9cb8dadc93df5a9e167f31dfc04eb8b45d271f2ec5b16c",
        "URG-04LX at Mines ParisTech; simondlevy/BreezySLAM examples/exp2.dat",
    ),
}
FULL_RATE_ENDS = 976053945.95
"""Intel: from here on only keyframes are in the log, s."""
SHORT = 10.0
"""Pairs less than this apart show the front end, s."""


@dataclass(frozen=True)
class Log:
    """One recorded run."""

    name: str
    stamps: np.ndarray
    """Shape (n,), ns from the first scan, rising."""
    ranges: np.ndarray
    """Shape (n, beams), m."""
    odom: np.ndarray
    """Shape (n, 3)."""
    geometry: ScanGeometry
    reference: np.ndarray
    """Relations, shape (m, 5): both times (s from the first scan), x, y, yaw; or poses, (m, 4): time, x, y, yaw."""

    @property
    def by_relations(self) -> bool:
        """Whether the reference is relations."""
        return self.reference.shape[1] == 5


def verified(folder: Path) -> None:
    """Raise SystemExit unless ``folder`` contains exactly the files of the manifest."""
    for name, (digest, origin) in MANIFEST.items():
        path = folder / name
        if not path.exists():
            raise SystemExit(f"{path}: missing ({origin})")
        found = hashlib.sha256(path.read_bytes()).hexdigest()
        if found != digest:
            raise SystemExit(f"{path}: sha256 {found}, expected {digest} ({origin})")


def load(folder: Path, name: str) -> Log:
    """Load ``intel`` (joined), ``intel1`` (the first 1088 s), ``intel4`` (those cut to 4 m), ``aces`` or ``csail``.

    Or MAP-SEED: a drive drawn through a map of the folder ``maps`` beside ``folder``, see ``drawn``.
    """
    kind, _, seed = name.partition("-")
    if kind in drawn.MAPS:
        stamps, ranges, odom, poses, geometry = drawn.drawn(folder.parent / "maps", kind, int(seed or 1))
        return Log(name, stamps, ranges, odom, geometry, np.column_stack((stamps / SECOND, poses)))
    file = name.rstrip("14")
    with np.load(folder / f"{file}.npz") as data:
        arrays = {key: data[key] for key in data.files}
    times, ranges = arrays["t"], arrays["ranges"].astype(float)
    kept = times < FULL_RATE_ENDS if name in {"intel1", "intel4"} else np.ones(len(times), bool)
    none = 50.0 if file == "aces" else 80.0
    beams = ranges.shape[1]
    # 180 beams leave out the one at +90 degrees.
    step = np.pi / 360 if beams == 361 else np.pi / 180
    geometry = ScanGeometry(-np.pi / 2, step, 0.05, 4.0 if name == "intel4" else none)
    if file == "intel":
        rows = np.loadtxt(io.BytesIO(gzip.decompress((folder / "intel.relations.gz").read_bytes())))
        inside = (rows[:, :2] >= times[0]).all(axis=1) & (rows[:, :2] <= times[kept][-1]).all(axis=1)
        reference = np.column_stack((rows[:, :2] - times[0], rows[:, [2, 3, 7]]))[inside]
    else:
        reference = np.column_stack((arrays.get("rbpf_t", times) - times[0], arrays["rbpf"]))
    stamps = np.round((times[kept] - times[0]) * SECOND).astype(np.int64)
    return Log(name, stamps, ranges[kept], arrays["odom"][kept], geometry, reference)


def scored(log: Log, stamps: np.ndarray, poses: np.ndarray) -> dict[str, float]:
    """Return the errors of a trajectory: by relations (m, degrees), or distance from the reference poses (m)."""
    seconds = stamps / SECOND
    if not log.by_relations:
        off = deviation(interpolate(seconds, poses, log.reference[:, 0]), log.reference[:, 1:])
        return statistics(off) | {"lost": float(len(log.stamps) - len(stamps)), "worst": float(off.max())}
    first, second = log.reference[:, 0], log.reference[:, 1]
    moved = between(interpolate(seconds, poses, first), interpolate(seconds, poses, second))
    error = between(log.reference[:, 2:], moved)
    way, turn = np.hypot(error[:, 0], error[:, 1]), np.degrees(np.abs(error[:, 2]))
    gap = np.abs(np.stack((first, second))[..., None] - log.stamps / SECOND).min(axis=2).max(axis=0)
    return statistics(way) | {
        "relations": float(len(way)),
        "short": float(way[np.abs(second - first) < SHORT].mean()),
        "at_scans": float(way[gap < 1e-4].mean()),
        "rotation": float(turn.mean()),
        "rotation_std": float(turn.std()),
        "lost": float(len(log.stamps) - len(stamps)),
    }


def statistics(errors: np.ndarray) -> dict[str, float]:
    """Return mean, standard deviation, median and 95th percentile."""
    return {
        "mean": float(errors.mean()),
        "std": float(errors.std()),
        "median": float(np.median(errors)),
        "p95": float(np.percentile(errors, 95)),
    }


def deviation(poses: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return the distances, shape (n,), after the rigid motion that best aligns ``poses`` with ``reference``."""
    a, b = poses[:, :2] - poses[:, :2].mean(axis=0), reference[:, :2] - reference[:, :2].mean(axis=0)
    left, _, right = np.linalg.svd(a.T @ b)
    turn = right.T @ np.diag((1.0, np.linalg.det(right.T @ left.T))) @ left.T
    return np.hypot(*(a @ turn.T - b).T)
