"""What forks of a command find imported, kernels of the simulated world included; see ``forked``."""

from pathlib import Path

import monstertruckd.tools.cli.main
import monstertruckd.tools.status.screen  # noqa: F401
from monstertruckd.tools.simulation import simulate
from monstertruckd.tools.simulation.config import load_simulated

simulate.shared_scene([load_simulated(Path(__file__).parents[2] / "configs" / "demo.yaml")])
