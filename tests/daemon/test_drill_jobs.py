"""A drill in several processes gives the report of one."""

import pytest

from monstertruckd.config.load import load_config
from monstertruckd.tools.drill.random_drill import Drill, run_leg
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from tests.daemon.wall_kit import ROOT

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(180)]


@pytest.mark.long
def test_the_number_of_processes_and_the_order_do_not_matter():
    config = load_config(ROOT / "configs" / "demo.yaml", SimulatedTruckConfig)[0]
    drill = Drill(7, 2, with_overlay(config, {"recorder": None}), leg=1)  # legs of one fault each
    alone = drill.run()
    assert drill.run(jobs=2) == alone
    assert [run_leg(leg) for leg in reversed(drill.legs())][::-1] == [[outcome] for outcome in alone.outcomes]
