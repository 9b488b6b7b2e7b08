"""``drill`` with a motor controller and a servo controller of another distribution."""

import json
from pathlib import Path

import pytest

from tests.plugin_kit import run_with, written

pytestmark = [pytest.mark.virtual, pytest.mark.long, pytest.mark.timeout(240)]

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
MODULE = """
from typing import Literal

from monstertruck_drivers.catalog import DRIVE, STEERING, DeviceKind
from monstertruck_drivers.epos.config import EposConfig
from monstertruck_drivers.maestro.config import MaestroConfig


class MotorConfig(EposConfig):
    kind: Literal["own_motor"]


class ServoConfig(MaestroConfig):
    kind: Literal["own_servos"]


MOTOR = DeviceKind(
    name="own_motor",
    doc="A motor controller",
    roles=(DRIVE,),
    settings="own_devices:MotorConfig",
    implementation="monstertruck_drivers.epos.driver:EposDriver",
    emulator="monstertruck_drivers.epos.emulator:emulated",
    identity="monstertruck_drivers.epos.identity:identify",
)
SERVOS = DeviceKind(
    name="own_servos",
    doc="A servo controller",
    roles=(STEERING,),
    settings="own_devices:ServoConfig",
    implementation="monstertruck_drivers.maestro.driver:MaestroDriver",
    emulator="monstertruck_drivers.maestro.emulator:emulated",
    identity="monstertruck_drivers.maestro.session:identify",
)
"""
FILES = {
    "own_devices.py": MODULE,
    "own_devices-1.0.dist-info/METADATA": "Metadata-Version: 2.1\nName: own-devices\nVersion: 1.0\n",
    "own_devices-1.0.dist-info/entry_points.txt": (
        "[monstertruck.devices]\nown_motor = own_devices:MOTOR\nown_servos = own_devices:SERVOS\n"
    ),
    "own.yaml": f"""
include: {CONFIGS}/demo.yaml
version: 2
recorder: null
blackbox: null
devices:
  drive: {{ driver: {{ kind: own_motor }} }}
  steering: {{ driver: {{ kind: own_servos }} }}
""",
}


@pytest.mark.parametrize(("options", "counted"), [((), "faults"), (("--families",), "trials")])
def test_a_robot_with_devices_of_another_distribution_can_be_drilled(
    options: tuple[str, ...], counted: str, tmp_path: Path
) -> None:
    place = written(FILES, tmp_path)
    arguments = "--config", str(place / "own.yaml"), "--count", "3", "--jobs", "1", "--json", *options
    report = json.loads(run_with(place, "drill", *arguments))
    assert (report[counted], report["unsafe"], report["stuck"]) == (3, 0, 0)
    if not options:
        assert report["unguarded"] == ["drive"], "no deadman line is known of these devices"
