"""Trackers with unknown or wrongly configured latency of the axles, on the reference model of the part tracking.

Each tracker that compensates the delay drives every course with axle delays of 0 to 150 ms: with no delay configured,
with 0, 50 and 150 ms of dead time configured, and with the right one. It is compared with pure pursuit on the same
axles, also without a configured delay.
"""

from typing import Any

import numpy as np

from benchmarks.navigation_parts import Options, Part
from benchmarks.navigation_parts.tracking import RESPONSES, built_in, drive, from_data

KINDS = ("lqr", "mpc")
SPEEDS = (0.5, 1.0, 1.5)
CONFIGURED: dict[str, dict[str, Any]] = {
    "nothing": {"dead_time": None, "lag": None},
    "none": {"dead_time": 0.0, "lag": 0.0},
    "50_ms": {"dead_time": 0.05, "lag": 0.0},
    "150_ms": {"dead_time": 0.15, "lag": 0.0},
    "right": {},
}
"""By what the configuration states."""
BOUND = 1.5
"""RMS error over that of pure pursuit."""


def run(options: Options) -> Part:
    part = Part()
    courses = built_in() if options.data is None else from_data(options)
    if options.quick:
        courses = dict(list(courses.items())[:1])
    lost = 0
    ratios: dict[tuple[str, str, float], list[float]] = {}
    right: dict[str, list[float]] = {}
    for course, points in courses.items():
        for speed in SPEEDS:
            for axles in RESPONSES:
                pursuit = drive(points, "pure_pursuit", speed, axles, "forward", **CONFIGURED["nothing"])
                lost += pursuit.lost
                print(f"{course} {speed} m/s {axles:8} pure pursuit {pursuit.rms:.1f} mm")
                for kind in KINDS:
                    cells = []
                    for name, configured in CONFIGURED.items():
                        found = drive(points, kind, speed, axles, "forward", **configured)
                        lost += found.lost
                        ratios.setdefault((kind, name, speed), []).append(found.rms / pursuit.rms)
                        if name == "right" and speed == 1.0:
                            right.setdefault(kind, []).append(found.rms)
                        cells.append(f"{name} {found.rms:.1f}/{found.worst:.0f}")
                    print(f"    {kind:8}" + "  ".join(cells), flush=True)
    part.add("lost", lost, 0)
    for (kind, name, speed), found in ratios.items():
        goal = BOUND if speed == 1.0 else None
        part.add(f"{kind}.{name}.{speed}.over_pure_pursuit", float(np.max(found)), goal)
    for kind, values in right.items():
        part.add(f"{kind}.right.1.0.rms_mm", float(np.median(values)), 2.5)
    return part
