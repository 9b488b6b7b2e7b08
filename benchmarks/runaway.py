"""Time until the gate detects a motor that does not obey, and the robot's distance until it stands.

    python benchmarks/runaway.py [--seeds 2] [--jobs 2] [--robot NAME ...]

Every drive kind (EPOS with one, two and four shafts, steppers) with every runaway, at every moment that reveals it:
while the robot drives, at rest, after an emergency stop, a stop, a disarm and a lost lease, and at the end of the
daemon. The whole daemon runs on the virtual clock; the simulated world alone judges. Time and distance to the event
count from the fault, or from the disobeyed order (a lease takes 0.25 s to expire).

On robots that have a deadman line, it stops a runaway that even the power stage does not stop. The last line is JSON.
"""

import argparse
import json
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import NamedTuple

import numpy as np

from benchmarks.runaway_parts.trial import Moment, Outcome, Robot, run, with_speeds

ROBOTS = {
    "demo": Robot("demo"),
    "full": Robot("full"),
    "ackermann": Robot("robots/ackermann"),
    "tricycle": Robot("robots/tricycle"),
    "skid_steer": Robot("robots/skid_steer"),
    "independent": Robot("robots/independent"),
    "sonar": Robot("robots/sonar", speed=0.3, creep=-10_000.0),
    "skid_stand": Robot("robots/skid_stand", role="wheels", speed=0.06, creep=30.0, run=45.0),
}
"""By name; ``sonar`` drives at 0.3 m/s."""

AFTER = (Moment.ESTOP, Moment.STOP, Moment.DISARM, Moment.LEASE, Moment.END)
READS_REST = {
    "drive": "signal velocity_actual scaled 0; signal velocity_averaged scaled 0; ",
    "wheels": "".join(f"signal rate_{motor} scaled 0; " for motor in (1, 2, 3, 4)),
}
READS_NOTHING = {
    "drive": "signal position_actual frozen; signal velocity_actual scaled 0; signal velocity_averaged scaled 0; ",
    "wheels": "".join(f"signal position_{motor} frozen; signal rate_{motor} scaled 0; " for motor in (1, 2, 3, 4)),
}
BLIND = "runs, position and velocity read rest"
RUNAWAYS: dict[str, tuple[str, tuple[Moment, ...]]] = {
    "ignores slower targets": ("runaway ignore", AFTER),
    "creeps": ("runaway creep CREEP", (*AFTER, Moment.ARMED)),
    "runs away": ("runaway run RUN", (*AFTER, Moment.DRIVING, Moment.ARMED)),
    "runs the other way": ("runaway run BACK", (Moment.DRIVING, Moment.ARMED, Moment.ESTOP)),
    "reverses sign": ("runaway reverse", (Moment.DRIVING,)),
    "position runs, velocity reads 0": ("STILL runaway creep CREEP", (Moment.ARMED, Moment.ESTOP)),
    BLIND: ("BLIND runaway creep CREEP", (Moment.ARMED, Moment.ESTOP)),
    "turns without its power stage": ("runaway run CREEP line", (Moment.DISARMED, Moment.ESTOP)),
}
"""Commands of the fault console by the runaway's name, and when it shows."""

LAPSE = 0.25
"""Seconds until a lease ends."""
GOALS = {
    "event s, p99": 0.5,
    "safe after it s, greatest": 1.0,
    "way after e-stop m, greatest": 0.3,
    "not found": 0,
    "never safe": 0,
    "left on": 0,
}


class Case(NamedTuple):
    """One trial."""

    robot: str
    runaway: str
    moment: Moment
    line: bool
    seed: int


def cases(robots: list[str], seeds: int) -> Iterator[Case]:
    """Yield every trial that the robots can show."""
    for name in robots:
        epos = ROBOTS[name].role == "drive"
        for runaway, (_, moments) in RUNAWAYS.items():
            beyond = runaway == "turns without its power stage"
            if runaway == BLIND and name in ("sonar", "skid_stand"):
                continue  # no lidar and no free wheels: nothing but the drive measures distances
            if beyond and name in ("sonar", "skid_steer", "skid_stand"):
                continue  # no servo controller, so no line
            for moment in moments:
                for seed in range(seeds):
                    yield Case(name, runaway, moment, beyond or (epos and seed % 2 == 1), seed)


def trial(case: Case) -> Outcome:
    """Run one trial."""
    robot = ROBOTS[case.robot]
    fault = RUNAWAYS[case.runaway][0].replace("STILL ", READS_REST[robot.role])
    fault = fault.replace("BLIND ", READS_NOTHING[robot.role])
    return run(robot, with_speeds(robot, fault), case.moment, line=case.line, seed=case.seed)


def seconds(case: Case, outcome: Outcome) -> float | None:
    """Return the time of the event, from when the robot must stand (s)."""
    if outcome.event is None:
        return None
    return max(outcome.event - (LAPSE if case.moment is Moment.LEASE else 0.0), 0.0)


def table(rows: list[tuple[Case, Outcome]]) -> None:
    """Print the figures by robot and runaway."""
    print("| robot | runaway | trials | event s, p50 | greatest | safe after it s, greatest | way m, greatest |")
    print("|---|---|---:|---:|---:|---:|---:|")
    for name, runaway in dict.fromkeys((case.robot, case.runaway) for case, _ in rows):
        part = [(case, one) for case, one in rows if (case.robot, case.runaway) == (name, runaway)]
        found = [at for case, one in part if case.moment is not Moment.END and (at := seconds(case, one)) is not None]
        after = [max(one.safe - one.event, 0.0) for _, one in part if one.safe is not None and one.event is not None]
        ways = [one.travelled for _, one in part]
        row = [name, runaway, f"{len(part)}"]
        row += [f"{np.median(found):.2f}", f"{max(found):.2f}"] if found else ["-", "-"]
        row += [f"{max(after):.2f}" if after else "-", f"{max(ways):.3f}"]
        print(f"| {' | '.join(row)} |")


def stopped_by_itself(outcome: Outcome) -> bool:
    """Whether the line stopped the motor before it had turned further than its commands explain."""
    return outcome.safe is not None and outcome.safe <= GOALS["event s, p99"]


def figures(rows: list[tuple[Case, Outcome]]) -> dict[str, float]:
    """Return the figures of the goals; at the end of the daemon the power stage counts."""
    running = [(case, one) for case, one in rows if case.moment is not Moment.END]
    found = [at for case, one in running if (at := seconds(case, one)) is not None]
    after = [max(one.safe - one.event, 0.0) for _, one in running if one.safe is not None and one.event is not None]
    ways = [one.travelled for case, one in rows if case.moment is Moment.ESTOP]
    ends = [one for case, one in rows if case.moment is Moment.END]
    return {
        "trials": len(rows),
        "not found": sum(one.event is None and not stopped_by_itself(one) for _, one in running),
        "no black box": sum(one.event is not None and one.boxed != one.event for _, one in running),
        "event s, p50": round(float(np.median(found)), 3),
        "event s, p99": round(float(np.percentile(found, 99)), 3),
        "safe after it s, greatest": round(max(after), 3),
        "never safe": sum(one.safe is None for _, one in rows),
        "way after e-stop m, greatest": round(max(ways), 3),
        "fastest before it m/s": round(max(abs(one.speed) for _, one in rows), 3),
        "left on": sum(one.powered for one in ends),
        "way after the end m, greatest": round(max((one.travelled for one in ends), default=0.0), 3),
    }


def main() -> int:
    """Run all trials; 0: the goals are met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--robot", action="append", choices=list(ROBOTS))
    options = parser.parse_args()
    planned = list(cases(options.robot or list(ROBOTS), options.seeds))
    with ProcessPoolExecutor(options.jobs, get_context("spawn")) as pool:
        rows = list(zip(planned, pool.map(trial, planned, chunksize=4), strict=True))
    table(rows)
    for case, one in rows:
        at = seconds(case, one)
        late = at is None or at > GOALS["event s, p99"]
        if one.safe is None or (late and case.moment is not Moment.END and not stopped_by_itself(one)):
            print(f"{case}: {one}")
    found = figures(rows)
    met = all(found[name] <= goal for name, goal in GOALS.items())
    print(json.dumps({"bench": "runaway", "figures": found, "goals": GOALS, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
