"""The overhead stand on rendered pictures: accuracy over the table, hand-over, frames a second, identities, faults.

    python benchmarks/stand.py [--seeds 2] [--poses 60] [--crossing 10]

Six cameras of 640 x 480 with hidden lenses and places over a table of 3 m x 3 m, calibrated by the stand's own
procedure from rendered boards and marks that a ruler measured to 1.5 mm; blur, noise and distortion as in
``tests/stand_kit.py``. Rendering is not counted in the frames a second.
"""

import argparse
import json
import math
import sys
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from monstertruck_estimation.vision.tags import TagReader
from monstertruck_runtime.clock import SECOND
from monstertruckd.tools.stand.tracking import StandTracker
from tests.stand_kit import simulated
from tests.stand_render import PictureQuality, level_tag

OUTPUT = Path(__file__).resolve().parents[1] / "runs" / "benchmarks" / "stand.json"
GOALS = {
    "position_rms_mm": 5.0,
    "heading_rms_deg": 1.0,
    "half_light_position_rms_mm": 5.0,
    "hand_over_jump_mm": 5.0,
    "frames_per_second_of_each_on_2_cores": 25.0,
    "identities_lost": 0,
    "bump_reported_s": 10.0,
    "unplugged_reported_s": 10.0,
}
CROSSING = 10.0
"""Seconds that five robots cross, 25 pictures each."""
HALF = PictureQuality(light=0.5)


def accuracy(
    stand: Any, poses: int, rng: np.random.Generator, look: PictureQuality | None
) -> tuple[list[float], list[float]]:
    """Errors of position, m, and heading, rad, of a tag of 80 mm at random places."""
    _, config, found, renderers, floor = stand
    placed = found.placed()
    off, turned = [], []
    for _ in range(poses):
        x, y, yaw = rng.uniform(-1.35, 1.35), rng.uniform(-1.35, 1.35), rng.uniform(-3.1, 3.1)
        placards = [*floor, level_tag(0, config.mark_size, x, y, yaw, 0.08)]
        seen = {name: TagReader(1).read(renderer.picture(placards, look)) for name, renderer in renderers.items()}
        for pose in StandTracker(placed, config.robots, config.marks).take(0, seen):
            off.append(math.hypot(pose.x - x, pose.y - y))
            turned.append(math.remainder(pose.yaw - yaw, math.tau))
    return off, turned


def hand_over(stand: Any) -> float:
    """Greatest jump, m, beyond the way driven, of a robot that crosses all views in steps of 8 mm."""
    _, config, found, renderers, floor = stand
    tracker = StandTracker(found.placed(), config.robots, config.marks)
    before, worst = None, 0.0
    for k, x in enumerate(np.arange(-1.3, 1.3, 0.02)):
        y = 0.4 * math.sin(2 * x)
        placards = [*floor, level_tag(0, config.mark_size, x, y, 0.2, 0.08)]
        seen = {name: TagReader(1).read(renderer.picture(placards)) for name, renderer in renderers.items()}
        for pose in tracker.take(k * SECOND // 25, seen):
            error = np.array((pose.x - x, pose.y - y))
            if before is not None:
                worst = max(worst, float(np.hypot(*(error - before))))
            before = error
    return worst


def crossing(stand: Any, seconds: float) -> tuple[int, float, float]:
    """Five robots that cross.

    Args:
        stand: calibrated.
        seconds: how long; a minute takes some minutes to render.

    Returns:
        Poses that are another robot's, longest time that a robot was not seen, s, and processor seconds of a picture
        read and tracked.
    """
    _, config, found, renderers, floor = stand
    tracker = StandTracker(found.placed(), config.robots, config.marks)
    readers = {name: TagReader(still=config.marks) for name in renderers}
    lost, spent, pictures = 0, 0.0, 0
    seen_at, longest = dict.fromkeys(range(5), 0.0), 0.0
    for k in range(round(25 * seconds)):
        t = k / 25
        where = {
            i: (1.1 * math.sin(0.5 * t + 1.25 * i), 1.1 * math.sin(0.8 * t + 2.1 * i), 0.5 * t + i) for i in range(5)
        }
        # Where two meet, the one hides the other: they drive through each other, as on no real table.
        placards = [*floor, *(level_tag(i, config.mark_size, x, y, yaw, 0.08) for i, (x, y, yaw) in where.items())]
        shown = {name: renderer.picture(placards) for name, renderer in renderers.items()}
        began = process_time()
        poses = tracker.take(k * SECOND // 25, {name: readers[name].read(picture) for name, picture in shown.items()})
        spent += process_time() - began
        pictures += len(shown)
        by_name = {pose.robot: pose for pose in poses}
        for i, (x, y, _) in where.items():
            pose = by_name.get(f"r{i + 1}")
            if pose is None:
                longest = max(longest, t - seen_at[i])
                continue
            seen_at[i] = t
            if math.hypot(pose.x - x, pose.y - y) > 0.05:
                lost += 1
    return lost, longest, spent / pictures


def faults(stand: Any) -> tuple[float, float]:
    """Seconds until a camera that was turned by 2 degrees, and one that was unplugged, are named."""
    _, config, found, renderers, floor = stand
    tracker = StandTracker(found.placed(), config.robots, config.marks)
    seen = {name: TagReader(1).read(renderer.picture(floor)) for name, renderer in renderers.items()}
    for k in range(50):
        tracker.take(k * SECOND // 25, seen)
        tracker.complaints(k * SECOND // 25)
    lens = found.placed()["c1"].lens
    shift = math.tan(math.radians(2.0)) * lens.matrix[0, 0]
    bumped = [s._replace(corners=s.corners + np.array((0.0, shift))) for s in seen["c1"]]
    reported = {"c1": math.inf, "c2": math.inf}
    for k in range(50, 350):
        now = k * SECOND // 25
        tracker.take(now, {name: bumped if name == "c1" else tags for name, tags in seen.items() if name != "c2"})
        for text in tracker.complaints(now):
            name = text.split()[1]
            if name in reported:
                reported[name] = min(reported[name], (k - 50) / 25)
    return reported["c1"], reported["c2"]


def main() -> int:
    """Measure; 0 = all goals are met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--poses", type=int, default=60)
    parser.add_argument("--crossing", type=float, default=CROSSING)
    arguments = parser.parse_args()
    off, turned, dim, jumps, overlaps = [], [], [], [], []
    lost, unseen, cost, reported = 0, 0.0, [], []
    for seed in range(arguments.seeds):
        stand = simulated(seed, robots=5)
        overlaps.append(stand[2].overlap_rms)
        rng = np.random.default_rng([seed, 9])
        found = accuracy(stand, arguments.poses, rng, None)
        off += found[0]
        turned += found[1]
        dim += accuracy(stand, arguments.poses // 2, rng, HALF)[0]
        jumps.append(hand_over(stand))
        mistaken, longest, spent = crossing(stand, arguments.crossing)
        lost, unseen = lost + mistaken, max(unseen, longest)
        cost.append(spent)
        reported.append(faults(stand))
        print(f"stand {seed}: {1000 * float(np.sqrt(np.mean(np.square(off)))):.2f} mm so far", flush=True)
    figures = {
        "stands": arguments.seeds,
        "poses": len(off),
        "poses_seen_share": round(len(off) / (arguments.seeds * arguments.poses), 3),
        "position_rms_mm": round(1000 * float(np.sqrt(np.mean(np.square(off)))), 2),
        "position_worst_mm": round(1000 * max(off), 2),
        "heading_rms_deg": round(math.degrees(float(np.sqrt(np.mean(np.square(turned))))), 2),
        "half_light_position_rms_mm": round(1000 * float(np.sqrt(np.mean(np.square(dim)))), 2),
        "hand_over_jump_mm": round(1000 * max(jumps), 2),
        "overlap_rms_mm": round(1000 * max(overlaps), 2),
        "read_and_track_ms": round(1000 * float(np.mean(cost)), 2),
        "frames_per_second_of_each_on_2_cores": round(2 / float(np.mean(cost)) / 6, 1),
        "crossing_s": arguments.crossing,
        "identities_lost": lost,
        "longest_unseen_s": round(unseen, 2),
        "bump_reported_s": max(bump for bump, _ in reported),
        "unplugged_reported_s": max(gone for _, gone in reported),
    }
    met = all(
        figures[name] >= goal if name.startswith("frames") else figures[name] <= goal for name, goal in GOALS.items()
    )
    OUTPUT.parent.mkdir(parents=True, exist_ok=True)
    OUTPUT.write_text(json.dumps(figures, indent=1), encoding="utf-8")
    print(json.dumps({"bench": "stand", "figures": figures, "goals": GOALS, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
