"""Two hours of driving in circles: the mapper's memory must stay bounded.

A truck with drifting wheels follows a closed path through the rooms of the emulators' world, with ten scans a second;
every lap adds keyframes until the least useful ones are removed. The estimation worker runs in this process, whose
resident memory is sampled every ten minutes.
"""

import os
from pathlib import Path

import numpy as np

from benchmarks import ROOT
from benchmarks.slam_parts.world_drives import ROOMS
from monstertruck_estimation.slam.config import SlamConfig
from monstertruck_estimation.slam.worker import SlamWorker
from monstertruck_estimation.slam.worker_io import ScanInput, Start, WorkerInput
from monstertruck_kinematics.se2 import between, compose
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.map_files import OCCUPIED, load_map
from monstertruck_sim.world.raycast import cast_rays, clearance

MAP = ROOT / "configs" / "worlds" / "rooms.yaml"
HOURS, SPEED, PERIOD = 2.0, 0.3, 0.1
BEAMS, RANGE = 682, 5.6
ANGLES = np.deg2rad(np.linspace(-120, 120, BEAMS))
NOTHING = np.zeros((0, 3)), np.zeros((0, 4))
GOALS = {"endurance_growth_mb": 10.0}
"""In the last 40 minutes, when the map has long been full."""


def way() -> np.ndarray:
    """Return poses along the closed path, one for each scan, shape (n, 3)."""
    corners = np.array((*ROOMS, ROOMS[0]))
    lengths = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))))
    stations = np.arange(0.0, lengths[-1], SPEED * PERIOD)
    x, y = (np.interp(stations, lengths, corners[:, k]) for k in (0, 1))
    smooth = np.ones(15) / 15
    x, y = (np.convolve(np.concatenate((v[-7:], v, v[:7])), smooth, "valid") for v in (x, y))
    yaw = np.arctan2(np.roll(y, -1) - np.roll(y, 1), np.roll(x, -1) - np.roll(x, 1))
    return np.stack((x, y, yaw), axis=-1)


def resident() -> float:
    """Return the resident memory of this process, MB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def run() -> tuple[dict[str, float], dict[str, float], bool]:
    """Return figures, goals, and whether all are met."""
    world, poses, rng = load_map(MAP), way(), np.random.default_rng(1)
    clear, (left, low) = clearance(world.cells == OCCUPIED), world.origin[:2]
    worker = SlamWorker()
    worker.step(WorkerInput(start=Start(SlamConfig())))
    odom, memory, off = poses[0].copy(), [], []
    count = round(HOURS * 3600 / PERIOD)
    for k in range(count):
        pose, before = poses[k % len(poses)], poses[(k - 1) % len(poses)]
        if k:
            odom = compose(odom, between(before, pose) * (1.02, 1.0, 1.0) + rng.normal(0.0, (0.001, 0.0005, 0.002)))
        here = np.full(BEAMS, pose[0]), np.full(BEAMS, pose[1])
        ranges = cast_rays(clear, world.resolution, left, low, *here, pose[2] + ANGLES, RANGE, *NOTHING)
        ranges = ranges + rng.normal(0.0, 0.01, BEAMS)
        scan = ScanInput(
            round(k * PERIOD * SECOND), ranges, ANGLES[0], ANGLES[1] - ANGLES[0], 0.02, RANGE, odom=tuple(odom)
        )
        reported = worker.step(WorkerInput(scan=scan))
        assert reported.estimate is not None
        off.append(np.hypot(*between(between(poses[0], pose), np.array(reported.estimate.pose))[:2]))
        if (k + 1) % round(count / (6 * HOURS)) == 0:
            memory.append(resident())
            keys, minute = reported.counts["keys"], (k + 1) * PERIOD / 60
            late = float(np.mean(off[-round(count / (6 * HOURS)) :]))
            print(f"minute {minute:3.0f}: {memory[-1]:.1f} MB, {keys} keyframes, off by {late:.3f} m", flush=True)
    figures = {f"endurance_{10 * (n + 1)}min_mb": round(value, 1) for n, value in enumerate(memory)}
    figures |= {
        "endurance_growth_mb": round(max(memory[-4:]) - memory[-5], 1),
        "endurance_keys": reported.counts["keys"],
        "endurance_off_m": float(np.mean(off[-count // 2 :])),
    }
    return figures, GOALS, figures["endurance_growth_mb"] <= GOALS["endurance_growth_mb"]
