"""Missions that decide, against an independent interpreter of their YAML.

    python -m benchmarks.missions [--missions 50] [--seed 1]

Generated missions (branches, loops, fallbacks, watches, limits, retries) run in the daemon's mission service on the
virtual clock; the services that would drive the robot end as a script says. Steps fail, the battery and the points of
interest change, the daemon restarts (in order, or killed) and an emergency stop comes at random moments. The
interpreter (``mission_parts/interpreter.py``) reads the same YAML and script and shares no code with the service. Both
must do the same steps and end with the same reason.
"""

import argparse
import contextlib
import json
import random
import sys
from collections import Counter

from benchmarks.mission_parts.generator import Script, mission, script
from benchmarks.mission_parts.interpreter import AmbiguousError, Outcome, expected
from benchmarks.mission_parts.world import done, read
from monstertruck_planners.missions.check import dead_ends

GOALS = {"missions": 50, "different": 0}


def main() -> int:
    """Run all missions; 0: all goals are met."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--missions", type=int, default=GOALS["missions"])
    options.add_argument("--seed", type=int, default=1)
    given = options.parse_args()
    different, met, steps = [], Counter[str](), 0
    for number in range(given.missions):
        rng = random.Random(f"{given.seed}/{number}")
        text, plan, wanted = drawn(rng)
        found = done(text, plan)
        steps += len(found.steps)
        met[found.reason] += 1
        met["restarts"] += found.restarts
        met["interruptions"] += found.interruptions
        if (wanted.reason, wanted.steps) != (found.reason, found.steps):
            different.append(number)
            print(f"mission {number}: {text}\nexpected {wanted}\nfound    {found}", file=sys.stderr)
    figures = {"missions": given.missions, "different": len(different), "steps": steps, **dict(sorted(met.items()))}
    good = given.missions >= GOALS["missions"] and not different
    print(json.dumps({"bench": "missions", "figures": figures, "goals": GOALS, "met": good}))
    return 0 if good else 1


def drawn(rng: random.Random) -> tuple[str, Script, Outcome]:
    """Return a mission accepted by the robot, the script of events, and the required outcome."""
    while True:
        text, plan = mission(rng), script(rng)
        if not dead_ends(read(text)):
            with contextlib.suppress(AmbiguousError):
                return text, plan, expected(text, plan)


if __name__ == "__main__":
    sys.exit(main())
