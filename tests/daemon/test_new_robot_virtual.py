"""What `new-robot` writes: its twin maps a room, on the virtual clock."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from monstertruck_schemas import topics
from monstertruck_schemas.req import ExploreOrder
from monstertruckd.tools.cli.main import app
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig
from tests.daemon.slam_kit import driven, share_beside_walls

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(900)]

ANT = (
    "--body differential --drive arduino_bridge --wheelbase 0.14 --track 0.2 --wheel-radius 0.035 --length 0.3 "
    "--width 0.26 --mass 2.5 --speed 0.5 --lidar sheet_lidar --beams 360 --direction counter_clockwise"
)
"""Two wheels, and a lidar that no driver knows."""
BEETLE = (
    "--body ackermann --drive vesc --drive-ratio 12.3 --steering drive --wheelbase 0.33 --track 0.25 "
    "--wheel-radius 0.051 --length 0.56 --width 0.31 --mass 3.7 --speed 0.8 --lidar rplidar:c1 --lidar-x 0.12 "
    "--attitude bno085 --battery drive --cells 3"
)
"""A car with a VESC."""


async def explore(rig: VirtualRig) -> None:
    operator = LocalOperator(rig.daemon, rig.clock)
    await operator.arm()
    order = {"order": ExploreOrder.START, "home": False, "budget": 60.0}
    await operator.call("explore", {**await operator.header(), **order})
    await rig.clock.sleep(14.0)


EVERY_WAY = (
    "--drive vesc --drive-ratio 12 --wheelbase 0.24 --track 0.2 --wheel-radius 0.05 --length 0.36 --width 0.3 "
    "--mass 4 --speed 0.5 --lidar ld19"
)
"""Three bodies that move sideways and turn on the spot."""


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("ant", ANT),
        pytest.param("beetle", BEETLE, marks=pytest.mark.long),
        pytest.param("crab", f"--body mecanum {EVERY_WAY}", marks=pytest.mark.long),
        pytest.param("fly", f"--body omni {EVERY_WAY}", marks=pytest.mark.long),
        pytest.param("spider", f"--body independent --steering maestro {EVERY_WAY}", marks=pytest.mark.long),
    ],
)
def test_the_twin_maps_a_room(tmp_path: Path, name: str, options: str):
    made = CliRunner().invoke(app, ["new-robot", name, "--folder", str(tmp_path), *options.split()])
    assert made.exit_code == 0, made.output
    loop = {"planner": "loop", "local_planner": "loop", "explorer": "loop"}
    run = driven(
        str(tmp_path / name / "twin.yaml"),
        explore,
        topics.MAP,
        blackbox=None,
        placement=loop,
        slam={"save": None},
    )
    away = np.hypot(*(run.truth[:, 1:3] - run.truth[0, 1:3]).T)
    assert away.max() > 0.4
    assert not run.truth[:, 5].any(), "it touches nothing"
    assert np.median(run.off(after=3.0)) < 0.03
    grid = run.said[topics.MAP.name][-1]
    free = (grid.cells >= 0) & (grid.cells <= 35)
    assert free.sum() * grid.resolution**2 > 8.0, "square metres"
    assert share_beside_walls(grid, "workshop") < 0.05
