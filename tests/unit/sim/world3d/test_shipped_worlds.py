"""Every shipped world in three dimensions carries the truck straight on from its start."""

from math import degrees, hypot, pi
from pathlib import Path

import pytest

from monstertruck_schemas.base import Pose2D
from monstertruck_sim.world.world import World
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig

CONFIGS = Path(__file__).resolve().parents[4] / "configs" / "world3d"
SECOND = 1_000_000_000


@pytest.mark.parametrize(
    ("name", "tilt"),
    [("house", 0.5), ("meadow", 2.0), ("ramps", 7.0), ("rubble", 0.1), ("side_slope", 11.0)],
)
def test_the_truck_drives_on(name, tilt):
    config = load_config(CONFIGS / f"{name}.yaml", SimulatedTruckConfig)[0]
    settings = config.sim.world
    if name == "house":  # before its first threshold
        step = settings.ground[0]
        settings = settings.model_copy(update={"start": Pose2D(x=step.x, y=step.y + 0.5, yaw=-pi / 2)})
    world = World(settings, 1)
    begin = world.truth(0)
    world.motors[0].command(0, -0.3 * 644 / (2 * pi * 0.075) * 60, 20_000.0)
    greatest = 0.0
    for tenth in range(1, 45):
        truth = world.truth(tenth * SECOND // 10)
        greatest = max(greatest, degrees(hypot(truth.pitch, truth.roll)))
        assert not truth.clutch_slipping
    assert hypot(truth.x - begin.x, truth.y - begin.y) > 1.0
    assert tilt <= greatest < 20.0
