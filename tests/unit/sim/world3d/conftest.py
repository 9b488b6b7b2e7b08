"""The field of the plane's tests in three dimensions."""

import pytest

from monstertruck_sim.world.config import WorldConfig


@pytest.fixture
def solid(field):
    """As ``field``; features of the ground as mappings."""

    def make(*, ground=(), **config):
        features = WorldConfig.model_validate({"engine": "mujoco", "ground": list(ground)}).ground
        return field(engine="mujoco", ground=features, **config)

    return make
