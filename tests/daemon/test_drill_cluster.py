"""A drill on a cluster: the report is that of one process, whoever computes it, and whoever dies."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import pytest

from monstertruck_runtime.errors import InputError, NoAnswerError
from monstertruckd.config.load import load_config
from monstertruckd.tools.drill import legs
from monstertruckd.tools.drill.random_drill import Drill, DrillReport, FaultOutcome, run_leg
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from tests.daemon.wall_kit import ROOT

pytestmark = [
    pytest.mark.virtual,
    pytest.mark.timeout(180),
    pytest.mark.filterwarnings("ignore"),  # of dask and its packages
]


def drill(count: int = 2) -> Drill:
    """Legs of one fault each."""
    config = load_config(ROOT / "configs" / "demo.yaml", SimulatedTruckConfig)[0]
    return Drill(7, count, with_overlay(config, {"recorder": None}), leg=1)


@cache
def alone() -> DrillReport:
    return drill().run()


@contextmanager
def processes(folder: Path, workers: int) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A scheduler and its workers, each a process of its own; the scheduler's address."""
    file = folder / "scheduler.json"
    base = [sys.executable, "-m", "distributed.cli"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    options = ["--scheduler-file", str(file), "--no-dashboard"]
    commands = [
        [f"{base[-1]}.dask_scheduler", "--host", "127.0.0.1", "--port", "0", *options],
        *([f"{base[-1]}.dask_worker", "--no-nanny", "--nthreads", "1", *options] for _ in range(workers)),
    ]
    started = [subprocess.Popen([*base[:-1], *command], cwd=folder, **quiet) for command in commands]
    try:
        from distributed import Client

        with Client(scheduler_file=str(file), timeout=60) as client:
            client.wait_for_workers(workers, timeout=60)
            address = client.scheduler.address
        yield address, started[1:]
    finally:
        for process in started:
            process.kill()
            process.wait()


@pytest.mark.long
def test_the_report_is_that_of_one_process_though_a_worker_is_killed_midway(tmp_path: Path):
    with processes(tmp_path, 2) as (address, workers):
        done: list[FaultOutcome] = []

        def kill(outcomes: list[FaultOutcome]) -> None:
            if not done:
                os.kill(workers[0].pid, signal.SIGKILL)
            done.extend(outcomes)

        assert drill().run(cluster=address, report=kill) == alone()
        assert workers[0].wait(10) == -signal.SIGKILL
        assert workers[1].poll() is None


def test_the_number_of_processes_and_the_order_do_not_matter():
    assert drill().run(jobs=2) == alone()
    legs = drill().legs()
    assert [run_leg(leg) for leg in reversed(legs)][::-1] == [[outcome] for outcome in alone().outcomes]


def test_a_leg_of_another_version_is_refused(monkeypatch: pytest.MonkeyPatch):
    (leg,) = drill(1).legs()
    monkeypatch.setattr(legs, "__version__", "9.9.9")
    with pytest.raises(InputError, match=r"sent to a worker with version 9\.9\.9"):
        run_leg(leg)


def test_without_a_scheduler_it_says_so(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(legs, "CONNECT", 0.2)
    with pytest.raises(NoAnswerError, match=r"tcp://127.0.0.1:1: no dask scheduler answers"):
        drill(1).run(cluster="tcp://127.0.0.1:1")
