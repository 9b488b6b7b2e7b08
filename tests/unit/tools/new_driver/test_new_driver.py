"""The package that `new-driver` writes is whole: its tests pass, ruff and mypy are content, the catalog takes it."""

import asyncio
import importlib
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from monstertruck_drivers.cable import MemoryPort
from monstertruck_drivers.catalog import DEVICES
from monstertruck_drivers.emulation import EmulatorSetup
from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.errors import InputError
from monstertruck_sim.world.config import WorldConfig
from monstertruck_sim.world.world import World
from monstertruckd.tools.cli.main import app
from monstertruckd.tools.new_driver.write import DriverKind, write_driver

ROOT = Path(__file__).resolve().parents[4]

pytestmark = pytest.mark.timeout(600)


def run(folder: Path, *module: str) -> None:
    places = ":".join(str(ROOT / name) for name in ("", "drivers", "planners", "schemas"))
    ended = subprocess.run(
        [sys.executable, "-m", *module],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": places, "MYPYPATH": f"{places}:{folder}:{folder}/tests"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr


@pytest.mark.parametrize("kind", DriverKind)
def test_its_tests_pass_and_its_style_is_clean(tmp_path: Path, kind: DriverKind):
    folder = write_driver(kind, "acme_l5", tmp_path)
    run(folder, "pytest", "-q", "-p", "no:cacheprovider")
    run(folder, "ruff", "check", ".")
    run(folder, "ruff", "format", "--check", ".")


@pytest.mark.long  # mypy reads the whole project without its cache
@pytest.mark.parametrize("kind", DriverKind)
def test_its_types_are_right(tmp_path: Path, kind: DriverKind):
    folder = write_driver(kind, "acme_l5", tmp_path)
    run(folder, "mypy", "--cache-dir", str(tmp_path / "mypy"), "acme_l5_driver", "tests")


@pytest.mark.parametrize("kind", DriverKind)
def test_the_catalog_takes_its_kind_and_emulates_it_on_the_truck(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: DriverKind
):
    monkeypatch.syspath_prepend(str(write_driver(kind, f"acme_{kind}", tmp_path)))
    row = importlib.import_module(f"acme_{kind}_driver.plugin").KIND
    assert DEVICES.fault(row) is None
    assert row.settings_class()().kind == row.name
    assert callable(row.implementation_class())

    async def emulated(clock: VirtualClock) -> dict[str, Any]:
        port = MemoryPort("/dev/test")
        async with asyncio.TaskGroup() as group:
            device = row.emulated(EmulatorSetup(row.role.name, None, clock, World(WorldConfig(), 0), 0, port))
            serving = group.create_task(row.serve(device, port.device))
            await asyncio.sleep(0)
            port.plug()
            found = await row.identify(port, clock)
            serving.cancel()
        return found

    assert run_virtual(emulated)["device"] == row.doc


def test_nothing_is_overwritten_and_odd_names_are_refused(tmp_path: Path):
    write_driver(DriverKind.LIDAR, "acme", tmp_path)
    with pytest.raises(InputError, match="exists; choose another name"):
        write_driver(DriverKind.MOTORS, "acme", tmp_path)
    for name in ("Acme", "../acme", "5x", "a__b", ""):
        with pytest.raises(InputError, match="expected a name of small letters"):
            write_driver(DriverKind.LIDAR, name, tmp_path)
    for name in ("ld19", "lidar"):
        with pytest.raises(InputError, match=f"has this name; expected another, such as acme_{name}"):
            write_driver(DriverKind.LIDAR, name, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["acme"]


def test_the_command_says_what_is_next(tmp_path: Path):
    done = CliRunner().invoke(app, ["new-driver", "sensor", "acme", "--folder", str(tmp_path)])
    assert done.exit_code == 0, done.output
    assert f"cd {tmp_path}/acme" in done.stdout
    assert "monstertruckd emulate acme --link /tmp/acme\nmonstertruckd probe acme --port /tmp/acme" in done.stdout
    refused = CliRunner().invoke(app, ["new-driver", "sonar", "acme"])
    assert refused.exit_code != 0
    assert "lidar" in refused.output
