"""Cost of a robot's worker processes: processor time of their starts, and memory.

    python -m benchmarks.workers [--runs 3]

One server forks all kinds of workers, as in the daemon, and starts them once more. For comparison, each kind is also
started by a separate process with its own server, like a fresh interpreter; its memory is measured after that server
has ended. Processor time is that of servers and workers, memory their proportional share (PSS); medians of ``--runs``.
Kernels are compiled before. The last line is JSON.
"""

import argparse
import json
import os
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from statistics import median

from monstertruck_runtime.actors.process import WorkerProcess
from monstertruckd.tools.install.kernels import WORKERS, compile_kernels

TIMEOUT = 120.0
"""Maximum time of a start, s."""


def started(stack: ExitStack, target: str) -> WorkerProcess:
    """Return a worker that has been built."""
    worker = WorkerProcess(target.partition(":")[0], target, TIMEOUT)
    stack.callback(worker.kill)
    worker.receive(TIMEOUT)
    return worker


def children(of: int) -> list[int]:
    """Return the child processes of a process."""
    return [int(child) for child in Path(f"/proc/{of}/task/{of}/children").read_text().split()]


def seconds(process: int) -> float:
    """Return the processor time of a process, s."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def megabytes(process: int) -> float:
    """Return the proportional share of a process in memory (PSS), MB."""
    line = next(row for row in Path(f"/proc/{process}/smaps_rollup").read_text().splitlines() if row.startswith("Pss:"))
    return int(line.split()[1]) * 1024 / 1e6


def forked(targets: tuple[str, ...]) -> dict[str, float]:
    """Start all workers by one server; return also the processor time of a second start of each."""
    with ExitStack() as stack:
        for target in targets:
            started(stack, target)
        (server,) = children(os.getpid())
        family = [server, *children(server)]
        first, memory = sum(map(seconds, family)), sum(map(megabytes, family))
    before = seconds(server)
    with ExitStack() as stack:
        for target in targets:
            started(stack, target)
        again = seconds(server) - before + sum(map(seconds, children(server)))
    return {"start_s": first, "again_s": again, "mb": memory}


def alone(target: str) -> dict[str, float]:
    """Start one worker by a separate server, which ends before the memory is measured."""
    with ExitStack() as stack:
        worker = started(stack, target)
        (server,) = children(os.getpid())
        assert worker.pid is not None
        used = seconds(server) + seconds(worker.pid)
        os.kill(server, 9)
        os.waitpid(server, 0)
        return {"start_s": used, "mb": megabytes(worker.pid)}


def measured(*arguments: str) -> dict[str, float]:
    """Return the figures of one run in a separate process."""
    command = [sys.executable, "-m", "benchmarks.workers", *arguments]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)  # our own
    figures: dict[str, float] = json.loads(done.stdout)
    return figures


def main(runs: int) -> int:
    """Measure both ways."""
    compile_kernels()
    together = [measured("--forked") for _ in range(runs)]
    apart = [[measured("--alone", target) for target in WORKERS] for _ in range(runs)]
    figures = {
        "workers": len(WORKERS),
        "forks": {name: round(median(run[name] for run in together), 2) for name in together[0]},
        "interpreters": {
            name: round(median(sum(one[name] for one in run) for run in apart), 2) for name in ("start_s", "mb")
        },
    }
    forks, fresh = figures["forks"], figures["interpreters"]
    assert isinstance(forks, dict)
    assert isinstance(fresh, dict)
    print("| workers | processor time of a start, s | of a second start, s | memory, MB |\n|---|---:|---:|---:|")
    print(f"| forks of one server | {forks['start_s']} | {forks['again_s']} | {forks['mb']:.0f} |")
    print(f"| an interpreter each | {fresh['start_s']} | {fresh['start_s']} | {fresh['mb']:.0f} |")
    goals = {"mb_of_interpreters": 1.0, "start_of_interpreters": 1.0}
    met = forks["mb"] < fresh["mb"] and forks["start_s"] < fresh["start_s"]
    print(json.dumps({"bench": "workers", "figures": figures, "goals": goals, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--forked", action="store_true", help="one run of all workers by one server")
    parser.add_argument("--alone", metavar="TARGET", help="one run of one worker by a server of its own")
    options = parser.parse_args()
    if options.forked:
        print(json.dumps(forked(WORKERS)))
    elif options.alone:
        print(json.dumps(alone(options.alone)))
    else:
        sys.exit(main(options.runs))
