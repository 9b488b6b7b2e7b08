"""Emulated devices hang in a folder of their user's own, where the configuration names no port."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from monstertruck_drivers.config import PortConfig
from monstertruck_runtime.clock import WallClock
from monstertruck_runtime.errors import BusyError, ConfigError, InputError, NotPermittedError
from monstertruckd.config.load import load_truck
from monstertruckd.tools.simulation import emulate as ports
from monstertruckd.tools.simulation.config import load_simulated
from monstertruckd.tools.simulation.emulate import claimed
from monstertruckd.tools.simulation.simulate import serve

CONFIGS = Path(__file__).resolve().parents[3] / "configs"
EMULATED = sorted(file for file in CONFIGS.rglob("*.yaml") if "\nsim:" in file.read_text())


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of a user; another one has another."""
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "user"))
    return tmp_path / "user/monstertruckd"


def paths(config) -> dict[str, Path]:
    hung = {role: device.port for role, device in config.devices.present().items()}
    return {role: port.path for role, port in hung.items() if isinstance(port, PortConfig)}


@pytest.mark.parametrize("file", EMULATED, ids=[str(file.relative_to(CONFIGS)) for file in EMULATED])
def test_simulator_and_daemon_of_a_shipped_configuration_meet_in_the_users_folder(file: Path, own: Path):
    config = load_simulated(file)
    assert paths(config) == {role: own / "ports" / config.robot / role for role in paths(config)}
    assert paths(load_truck(file)[0]) == paths(config)


def test_a_named_port_counts_and_null_takes_it_back(own: Path, tmp_path: Path):
    child, grandchild = tmp_path / "child.yaml", tmp_path / "grandchild.yaml"
    named = f"devices: {{lidar: {{port: {{path: {tmp_path}/lidar}}}}}}"
    child.write_text(f"include: {CONFIGS}/demo.yaml\nversion: 2\nrobot: digger\n{named}\n")
    grandchild.write_text("include: child.yaml\nversion: 2\ndevices: {lidar: {port: null}}\n")
    assert paths(load_simulated(child))["lidar"] == tmp_path / "lidar"
    assert paths(load_simulated(child))["drive"] == own / "ports/digger/drive"
    assert paths(load_simulated(grandchild))["lidar"] == own / "ports/digger/lidar"


def test_a_real_robot_has_to_name_its_ports(tmp_path: Path):
    file = tmp_path / "truck.yaml"
    file.write_text("version: 2\ndevices: {lidar: {driver: {kind: hokuyo_urg}}}\n")
    with pytest.raises(ConfigError, match=r"truck\.yaml:2: devices\.lidar\.port: missing; it has no default$"):
        load_truck(file)


async def test_a_second_simulator_is_refused_and_leaves_the_first_alone(own: Path):
    config = load_simulated(CONFIGS / "demo.yaml")
    with claimed(*paths(config).values()), pytest.raises(BusyError) as refused:
        await serve(WallClock(), [config], print)
    port = f"{own}/ports/truck/lidar: another program (process {os.getpid()}) serves this port"
    assert str(refused.value).startswith(
        f"{port}: probably another `simulate` on this computer; end it with Ctrl-C in its terminal"
    )
    assert refused.value.reason.exit_code == 7
    with claimed(*paths(config).values()):
        assert own.stat().st_mode & 0o007 == 0, "nobody else's"


async def test_nor_does_it_take_the_emulated_computer_of_the_first(own: Path, tmp_path: Path):
    file = tmp_path / "full.yaml"
    file.write_text(f"include: {CONFIGS}/full.yaml\nversion: 2\nmachine: {tmp_path}/machine\n")
    (tmp_path / "machine").symlink_to(tmp_path)
    with (tmp_path / ".machine.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(BusyError, match="machine: another program serves this port"):
            await serve(WallClock(), [load_simulated(file)], print)
    assert (tmp_path / "machine").readlink() == tmp_path


def test_a_folder_that_others_may_write_is_refused(own: Path):
    own.mkdir(parents=True)
    own.chmod(0o777)
    with pytest.raises(NotPermittedError, match="expected a folder that only its owner may write"), claimed(own / "x"):
        pass


def test_a_port_that_this_user_may_not_make_is_refused_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    @contextmanager
    def forbidden(*links: Path) -> Iterator[None]:
        raise PermissionError(13, "Permission denied", str(links[0]))
        yield

    monkeypatch.setattr(ports, "reserved", forbidden)
    port = tmp_path / "lidar"
    with pytest.raises(NotPermittedError, match=rf"^{port}: this user may not create a port there$"), claimed(port):
        pass


def test_what_is_no_link_keeps_its_name(own: Path):
    port = own / "ports/truck/lidar"
    port.parent.mkdir(parents=True)
    own.chmod(0o750)
    port.write_text("mine")
    with pytest.raises(InputError, match="is not a link"), claimed(port):
        pass
    assert port.read_text() == "mine"
