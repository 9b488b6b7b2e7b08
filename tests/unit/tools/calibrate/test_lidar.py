"""Mount of the lidar: what tells it, and what is refused."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from monstertruck_runtime.errors import InputError, RequestRefusedError
from monstertruck_schemas import topics
from monstertruck_schemas.sensor import VALID_BEAM
from monstertruckd.config.load import load_config
from monstertruckd.config.truck import TruckConfig
from monstertruckd.tools.calibrate.lidar import (
    HEIGHTS,
    LidarLeg,
    LidarWizard,
    beam_tilt,
    fit_mount,
    fit_offset,
    result_of,
    seen_motion,
)

CONFIGS = Path(__file__).resolve().parents[4] / "configs"
TRUE = np.array((0.13, 0.02, 0.04, 1.01, 0.0))


def leg(way, turn, travel=0.0):
    x, y, yaw = seen_motion(TRUE, np.array((way,)), np.array((turn,)), np.array((travel,)))[0].tolist()
    return LidarLeg(way, (x, y, yaw), 0.004, travel)


LEGS = [leg(1.0, 0.0), *(leg(0.66, 1.5, -0.01) for _ in range(4)), *(leg(0.66, -1.5) for _ in range(4))]


def test_the_mount_is_what_makes_the_bodys_motion_the_lidars():
    fit = fit_mount(LEGS, (0.1, 0.0, 0.0), 0.001)
    assert fit.parameters[:3] == pytest.approx(TRUE[:3], abs=1e-3)


def test_a_truck_that_may_crab_widens_the_yaw_alone():
    narrow, wide = (result_of(LEGS, (0.1, 0.0, 0.0), crab, None) for crab in (0.001, 0.05))
    halves = [[(e.high - e.low) / 2 for e in result.estimates] for result in (narrow, wide)]
    assert halves[1][2] > 5 * halves[0][2]
    assert halves[1][0] < 2 * halves[0][0]
    assert wide.partial, "pitch and roll of an earlier run stay"


def test_arcs_to_one_side_are_refused():
    with pytest.raises(InputError, match="two arcs in each direction"):
        result_of(
            [replace(leg, seen=(leg.seen[0], leg.seen[1], abs(leg.seen[2]))) for leg in LEGS], (0, 0, 0), 0.01, None
        )


@pytest.mark.parametrize("offset", [-0.2, -0.02, 0.0, 0.013, 0.15])
def test_an_offset_of_the_clocks(offset):
    rng = np.random.default_rng(3)

    def yaw(t):
        return 0.3 * np.sin(1.3 * t) + 0.1 * np.sin(4.1 * t)

    scans, stamps = np.arange(0, 12, 0.1), np.arange(0, 12, 0.02)
    seen = yaw(scans) + 0.002 * rng.standard_normal(scans.size)
    found = fit_offset([(scans, seen, stamps, 0.97 * yaw(stamps - offset))], None)
    assert found.value.low - 0.002 < offset < found.value.high + 0.002
    assert found.value.half < 0.005
    assert math.isfinite(found.value.half)


def test_the_tilt_of_the_beam_follows_from_its_heights():
    assert beam_tilt((0.25, 0.21, 0.28), (2.0, 3.0)) == pytest.approx((0.02, 0.01), abs=1e-5)


@pytest.mark.parametrize(("heights", "named"), [((0.25, 2.5, 0.25), "ahead"), ((0.25, 0.25, 1.8), "left")])
def test_heights_that_no_lidar_has_are_refused_by_name(heights, named):
    with pytest.raises(InputError, match=rf"^{named}: a beam 25 cm high at .* measure again, in cm"):
        beam_tilt(heights, (2.0, 2.0))
    assert all(step.low == 1.0 for step in HEIGHTS), "metres in place of cm are refused, too"


class Level:
    """A truck on a level floor whose compass says 0.01 and -0.02 rad, and whose joints take that out."""

    def __init__(self, name):
        self.config = load_config(CONFIGS / name, TruckConfig)[0]

    async def collect(self, step):
        if step.topic is topics.STABILISER:
            return [SimpleNamespace(pitch=-0.01, roll=0.02)] * step.count
        if step.topic is topics.COMPASS:
            return [SimpleNamespace(pitch=0.01, roll=-0.02)] * step.count
        ranges, codes = np.full(5, 2.0), np.full(5, VALID_BEAM)
        return [SimpleNamespace(start_angle=0.0, angle_increment=1.0, ranges=ranges, codes=codes)] * step.count

    async def ask(self, step):
        return {"centre": 25.0, "ahead": 21.0, "left": 27.0}[step.name]


@pytest.mark.parametrize(("name", "found"), [("truck.yaml", (0.02, 0.01)), ("demo.yaml", (0.01, 0.03))])
async def test_its_mounts_tilt_is_that_of_the_beam_less_the_bodys_and_the_joints(name, found):
    estimates = await LidarWizard(heights=True)._level(Level(name))
    assert [e.value for e in estimates] == pytest.approx(found, abs=1e-5)


async def test_a_lidar_that_hangs_stays_upside_down():
    context = Level("demo.yaml")
    lidar = context.config.devices.lidar
    hung = lidar.model_copy(update={"mount": lidar.mount.model_copy(update={"roll": math.pi})})
    devices = context.config.devices.model_copy(update={"lidar": hung})
    context.config = context.config.model_copy(update={"devices": devices})
    _, roll = await LidarWizard(heights=True)._level(context)
    assert roll.value == pytest.approx(0.03 - math.pi, abs=1e-5)


async def test_a_truck_without_a_compass_is_refused_before_it_drives():
    context = Level("truck.yaml")
    context.config = context.config.model_copy(
        update={"devices": context.config.devices.model_copy(update={"compass": None})}
    )
    with pytest.raises(RequestRefusedError, match="compass"):
        await LidarWizard()(context)
