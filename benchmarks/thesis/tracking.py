"""5.5 Tracking: RMS and maximum distance from the path for each steering mode, our trackers and the published rules.

The truck with dead time, lag and turning rate of its axles at the author's 0.2 m/s, from 5 cm beside the path. The
final error is measured at the end of the path (1e6: not reached), the steering effort is the turn of both axles. In
crab the truck keeps its heading, so it drives only the course whose direction stays within the axles' range; the
heading error is then the turn of the path.
"""

import numpy as np

from benchmarks.navigation_parts import Options, Part
from benchmarks.navigation_parts.tracking import TRUCK, Result, built_in, drive
from monstertruckd.tools.figures import new_figure, write_figure

MODES = ("front", "counter", "crab", "hybrid")
SHIFTS = "shifts"
"""To the side and back twice, by 0.36 m over 2 m, at most 0.28 rad from straight on."""
TRACKERS = {"lqr": "ours", "fuzzy": "fuzzy, our rules", "fuzzy_published": "published"}


def run(options: Options) -> Part:
    part = Part()
    courses = {name: 1.4 * points for name, points in built_in().items()} | {SHIFTS: shifts()}
    found: dict[tuple[str, str, str], Result] = {}
    for course, points in list(courses.items())[: 1 if options.quick else None]:
        for tracker in TRACKERS:
            for mode in MODES[:2] if options.quick else modes(course):
                way = points[:120] if options.quick else points
                row = drive(way, tracker, 0.2, "lag", "forward", TRUCK, steering=mode, angle=0.4)
                found[course, tracker, mode] = row
                prefix = f"{course}.{tracker}.{mode}"
                part.add(f"{prefix}.rms_mm", row.rms)
                part.add(f"{prefix}.max_mm", row.worst)
                part.add(f"{prefix}.heading_rms_rad", row.heading)
                part.add(f"{prefix}.end_mm", min(row.end, 1e6))
                part.add(f"{prefix}.steering_effort_rad", row.effort)
                part.add(f"{prefix}.seconds", row.seconds)
                part.add(f"{prefix}.arrived", int(row.arrived))
    if not options.quick:
        for course in courses:
            for mode in modes(course):
                ours, theirs = (found[course, tracker, mode] for tracker in ("lqr", "fuzzy_published"))
                part.add(f"{course}.{mode}.ours_over_published_rms", ours.rms / theirs.rms, 1.0)
    draw(options, found, courses)
    return part


def modes(course: str) -> tuple[str, ...]:
    """Return the modes in which the truck can follow a course."""
    return MODES if course == SHIFTS else tuple(mode for mode in MODES if mode != "crab")


def shifts() -> np.ndarray:
    """Return the places of the course that a truck in crab can follow, shape (n, 2), m."""
    x = np.arange(0.0, 8.0, 0.025)
    return np.column_stack((x, 0.18 * (1.0 - np.cos(np.pi * x / 2.0))))


def draw(options: Options, found: dict, courses: dict[str, np.ndarray]) -> None:
    names = list(dict.fromkeys(key[0] for key in found))
    figure = new_figure(14, 4 * len(names))
    for line, course in zip(figure.subplots(len(names), 4, squeeze=False), names, strict=True):
        for axes, mode in zip(line, MODES, strict=True):
            if mode not in modes(course):
                axes.set_axis_off()
                continue
            axes.plot(*courses[course].T, color="0.7", lw=4)
            for tracker in TRACKERS:
                if (row := found.get((course, tracker, mode))) is not None:
                    axes.plot(*row.track[:, :2].T, lw=1, label=f"{tracker} {row.rms:.0f}/{row.worst:.0f} mm")
            axes.set_title(f"{course}, {mode}", fontsize=9)
            axes.set_aspect("equal", "datalim")
            if mode == MODES[0]:
                axes.legend(fontsize=7)
    write_figure(figure, options.out / "tracking.png")
