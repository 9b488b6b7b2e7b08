"""Closing error of dead reckoning after a square of 10 m, with the signs calibrated only, and after ``calibrate all``.

A truck with hidden values is calibrated in the order of ``calibrate all`` through the whole daemon. Then it drives a
square: sides by its own count, corners by its own odometry. The closing error is the distance between the end points by
odometry and by the truth. The same drive is repeated with only the directions of motor and servos calibrated, which a
truck needs to drive a square at all.
"""

import logging
import math
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from benchmarks import ROOT
from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.errors import TruckError
from monstertruck_schemas import topics
from monstertruckd.config.calibration import CalibrationStore, Result, with_values
from monstertruckd.config.load import load_config
from monstertruckd.config.wizards import WizardRun
from monstertruckd.tools.calibrate.motion import Mover
from monstertruckd.tools.calibrate.steps import MoveRecord, MoveStep
from monstertruckd.tools.calibrate.wizard import missing
from monstertruckd.tools.cli.calibrate import wizard_of
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from monstertruckd.tools.simulation.virtual_rig import VirtualRig
from tests.calibration_kit import START_UP, LocalTruck, hidden, run_session

GOAL: Final = 0.2
"""Goal as a share of the closing error with signs alone."""
SIGNS: Final = ("inverted", "front_direction", "rear_direction")
PATH: Final = 10.0
"""m."""
ANGLE: Final = 0.3
"""Steering angle of both axles, against each other, in the corners, rad."""
SPEED: Final = 0.15
HIDDEN: Final = ("battery", "compass", "drive", "steering", "odometry", "lidar")


def truck(seed: int, folder: Path) -> SimulatedTruckConfig:
    """Return a truck with hidden values, whose calibration is in ``folder``."""
    base = load_config(ROOT / "configs" / "yard.yaml", SimulatedTruckConfig)[0]
    quiet = base.model_copy(update={"recorder": None, "blackbox": None, "state_directory": folder})
    return hidden(quiet, np.random.default_rng([seed, 31]), seed, HIDDEN)


def results_of(config: SimulatedTruckConfig) -> list[Result]:
    """Return the results of the wizards so far."""
    current = CalibrationStore(config.calibration_folder, config.robot).current()
    return [] if current is None else list(current.results.values())


def left(config: SimulatedTruckConfig) -> list[WizardRun]:
    """Return the wizards still to be run."""
    return missing(config, {result.wizard: result for result in results_of(config)})


def step(config: SimulatedTruckConfig, seed: int) -> None:
    """Run the next wizard."""
    (first, *_) = left(config)
    rng = np.random.default_rng([seed, 32, len(results_of(config)), first.step.rough])
    session = run_session(config, wizard_of(first), rng)
    print(
        f"truck {seed}: {first.name}{' (rough)' if first.step.rough else ''}: {session.seconds / 60:.1f} min",
        flush=True,
    )


def signs(results: Sequence[Result]) -> list[Result]:
    """Return the results that state the directions of motor and servos."""
    kept = [(result, tuple(e for e in result.estimates if e.name in SIGNS)) for result in results]
    return [result.model_copy(update={"estimates": estimates}) for result, estimates in kept if estimates]


def closing_error(config: SimulatedTruckConfig) -> float:
    """Return the closing error of a square to the left, m."""

    def turned(record: MoveRecord) -> bool:
        yaws = np.unwrap([o.pose.yaw for o in record.of(topics.ODOMETRY)])
        return bool(yaws.size) and abs(float(yaws[-1] - yaws[0])) >= math.pi / 2

    async def main(clock: VirtualClock) -> float:
        rig = VirtualRig(config, clock)
        async with rig.running():
            await clock.sleep(START_UP)
            operator = LocalTruck(rig.daemon, clock)
            mover = Mover(operator, clock, config.chassis())  # type: ignore[arg-type]
            corner = math.pi / 2 / config.chassis().bicycle.curvature(ANGLE, -ANGLE)
            side = MoveStep("side", SPEED, metres=PATH / 4 - corner, also=(topics.ODOMETRY,))
            arc = MoveStep("corner", SPEED, ANGLE, -ANGLE, 2.0 * corner, done=turned, also=(topics.ODOMETRY,))
            began, poses = rig.world.truth(clock.now()), []
            for move in (side, arc) * 4:
                poses += [o.pose for o in (await mover.move(move, lambda *_: None)).of(topics.ODOMETRY)]
            ended = rig.world.truth(clock.now())
            true = _moved((began.x, began.y, began.yaw), (ended.x, ended.y))
            first, last = poses[0], poses[-1]
            return math.dist(true, _moved((first.x, first.y, first.yaw), (last.x, last.y)))

    return run_virtual(main)


def _moved(began: tuple[float, float, float], ended: tuple[float, float]) -> tuple[float, float]:
    """Return the end in the axes of the start, m."""
    dx, dy = ended[0] - began[0], ended[1] - began[1]
    c, s = math.cos(began[2]), math.sin(began[2])
    return c * dx + s * dy, c * dy - s * dx


def compared(config: SimulatedTruckConfig) -> tuple[float, float]:
    """Return the closing errors (m) with the signs calibrated only, and with the whole calibration."""
    results = results_of(config)
    return tuple(closing_error(with_values(config, some, "calibration")) for some in (signs(results), results))  # type: ignore[return-value]


def square(count: int) -> tuple[dict[str, Any], dict[str, Any], bool]:
    """Measure this many trucks; return closing errors, goals, and whether they are met."""
    logging.disable(logging.CRITICAL)
    before, after = [], []
    for seed in range(count):
        with TemporaryDirectory(prefix="monstertruck-") as folder:
            config = truck(seed, Path(folder))
            try:
                while left(config):
                    step(config, seed)
                errors = compared(config)
            except TruckError as error:
                print(f"truck {seed}: {error}", flush=True)
                errors = math.nan, math.inf
        before.append(errors[0])
        after.append(errors[1])
        print(f"truck {seed}: closing error {errors[0]:.3f} m by its signs, {errors[1]:.3f} m calibrated", flush=True)
    shares = [a / b for a, b in zip(after, before, strict=True)]
    found = {
        "path": PATH,
        "signs_alone": [round(e, 4) for e in before],
        "calibrated": [round(e, 4) for e in after],
        "worst_share": max(shares),
    }
    return found, {"worst_share": GOAL}, all(share <= GOAL for share in shares)
