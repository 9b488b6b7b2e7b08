"""Each of the other wizards alone through the whole daemon, on robots that hide only the quantities it measures.

For every wizard the benchmark judges the share of its estimates whose interval contains the truth, and that every
choice (a sign, a direction) is right.
"""

import logging
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from monstertruck_runtime.errors import TruckError
from monstertruckd.config.calibration import WizardName
from monstertruckd.tools.calibrate.camera import CameraWizard
from monstertruckd.tools.calibrate.imu import ImuWizard
from monstertruckd.tools.calibrate.lidar import LidarWizard
from monstertruckd.tools.calibrate.odometry import OdometryWizard
from monstertruckd.tools.calibrate.slip import SlipWizard
from monstertruckd.tools.calibrate.sonar import SonarWizard
from monstertruckd.tools.calibrate.stabiliser import StabiliserWizard
from monstertruckd.tools.calibrate.wizard import Wizard
from monstertruckd.tools.simulation.config import with_overlay
from tests.calibration_kit import Verdict, run_session, verdicts
from tests.calibration_robots import robot_of

WIZARDS: Final[dict[WizardName, Wizard]] = {
    "odometry": OdometryWizard(),
    "lidar": LidarWizard(heights=True),
    "imu": ImuWizard(),
    "slip": SlipWizard(),
    "stabiliser": StabiliserWizard(),
    "camera": CameraWizard(patience=120.0),
    "sonar": SonarWizard(),
}
GOAL: Final = 0.9
"""Share of the numbers inside their intervals."""


def alone(count: int, engine: str = "plane") -> tuple[dict[str, Any], dict[str, Any], bool]:
    """Run each wizard on this many robots in an engine's world; return figures, goals, and whether they are met."""
    logging.disable(logging.CRITICAL)
    inside, wrong = {}, {}
    for name, wizard in WIZARDS.items():
        found = [verdict for seed in range(count) for verdict in _session(name, wizard, seed, engine)]
        numbers = [verdict.holds for verdict in found if verdict.low is not None]
        inside[name] = round(sum(numbers) / max(len(numbers), 1), 4)
        wrong[name] = sum(not verdict.holds for verdict in found if verdict.low is None)
        print(f"{name}: {sum(numbers)} of {len(numbers)} numbers inside, {wrong[name]} choices wrong", flush=True)
    figures = {"count": count, "inside": inside, "wrong_choices": wrong}
    met = min(inside.values()) >= GOAL and not any(wrong.values())
    return figures, {"inside": GOAL, "wrong_choices": 0}, met


def _session(name: WizardName, wizard: Wizard, seed: int, engine: str) -> list[Verdict]:
    world: dict[str, Any] = {"engine": engine}
    if name == "camera" and engine != "plane":
        world["camera"] = {"rendered": True}
    with TemporaryDirectory(prefix="monstertruck-") as folder:
        config = with_overlay(robot_of(name, Path(folder), seed), {"sim": {"world": world}})
        try:
            session = run_session(config, wizard, np.random.default_rng([seed, 41]))
        except TruckError as error:
            print(f"{name}, robot {seed}: {error}", flush=True)
            return [Verdict(f"{name}.finished", False, None, None, True)]
        found = verdicts(session.result, config)
    print(f"{name}, robot {seed}: outside {[v.name for v in found if not v.holds] or 'none'}", flush=True)
    return found
