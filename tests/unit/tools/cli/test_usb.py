"""The commands: the tree for people and for programs; the port of a cable, found and written down."""

import asyncio
import json
from pathlib import Path
from typing import Any, Self

import pytest
import typer
from typer.testing import CliRunner

from monstertruck_drivers.computer import Machine, Sysfs
from monstertruck_drivers.usb.config import UsbPortConfig
from monstertruck_runtime.errors import InputError, NoAnswerError, NotFoundError
from monstertruck_runtime.yaml_files import read_yaml
from monstertruck_schemas.usb import UsbNode, UsbState, UsbTree
from monstertruckd.tools.cli import usb as commands
from monstertruckd.tools.cli.find_port import config_line, find_cable, write_port
from monstertruckd.tools.cli.usb_tree import HEADINGS, draw, rows
from tests.unit.drivers.usb.rig import PORTS, Bench, emulated_truck, play

NODES = (
    UsbNode(name="usb1", parent=None, title="xHCI", usb_id="1d6b:0002", hub=True, state=UsbState.PRESENT),
    UsbNode(name="1-1", parent="usb1", title="Hub", usb_id="05e3:0608", hub=True, state=UsbState.PRESENT),
    UsbNode(
        name="1-1.3",
        parent="1-1",
        title="FT232R",
        usb_id="0403:6001",
        tty="ttyUSB0",
        role="drive",
        state=UsbState.PRESENT,
        replugs=2,
        over_current=1,
        autosuspend=True,
        latency_ms=16,
    ),
    UsbNode(name="1-7.2", parent="1-7", role="compass", state=UsbState.ABSENT),
)


def app() -> typer.Typer:
    mounted = typer.Typer()
    mounted.command("usb")(commands.usb)
    mounted.command("find-port")(commands.find_port)
    return mounted


def test_the_table_has_everything_a_script_wants():
    lines = rows(NODES)
    assert all(len(line) == len(HEADINGS) for line in lines)
    assert lines[0][:4] == ("usb1", "-", "-", "present")
    assert lines[2][:7] == ("1-1", "3", "drive", "present", "2", "0403:6001", "ttyUSB0")
    assert lines[2][7] == "FT232R, over-current 1, may be suspended, latency 16 ms"
    assert lines[3] == ("1-7", "2", "compass", "absent", "0", "-", "-", "-")


def test_the_drawn_tree_nests_by_port():
    [root] = draw(NODES)
    hub, unseen = root.children
    assert "port 1  hub 1-1" in str(hub.label)
    [drive] = hub.children
    for part in ("port 3", "drive", "FT232R 0403:6001 ttyUSB0", "present", "2 replugs", "may be suspended"):
        assert part in str(drive.label)
    assert "1-7 never connected" in str(unseen.label)
    assert "port 2  compass" in str(unseen.children[0].label)
    assert "absent" in str(unseen.children[0].label)


def fake_client(tree: UsbTree | None) -> type:
    class Client:
        robot = "truck"

        def __init__(self, *_: Any, **__: Any) -> None:
            pass

        async def __aenter__(self) -> Self:
            return self

        async def __aexit__(self, *_: object) -> None:
            pass

        async def get_retained(self, topic: Any) -> UsbTree | None:
            assert topic.name == "health/usb"
            return tree

    return Client


def test_usb_asks_the_robot(monkeypatch: pytest.MonkeyPatch):
    tree = UsbTree(stamp=0, received=0, seq=0, nodes=NODES)
    monkeypatch.setattr("monstertruck_runtime.client.TruckClient", fake_client(tree))
    result = CliRunner().invoke(app(), ["usb", "--json"])
    assert [UsbNode.model_validate(row, strict=False) for row in json.loads(result.stdout)] == list(NODES)
    result = CliRunner().invoke(app(), ["usb"])
    header, *lines = result.stdout.splitlines()
    assert header.split() == list(HEADINGS)
    assert [line.split()[:3] for line in lines] == [list(row[:3]) for row in rows(NODES)], "piped, it is the table"

    monkeypatch.setattr("monstertruck_runtime.client.TruckClient", fake_client(None))
    result = CliRunner().invoke(app(), ["usb"])
    assert isinstance(result.exception, NotFoundError)


def test_usb_shows_this_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    machine, _ = emulated_truck(tmp_path)
    monkeypatch.setattr("monstertruckd.tools.cli.usb_tree.Sysfs", lambda: machine.sysfs)
    result = CliRunner().invoke(app(), ["usb", "--local"])
    lines = [" ".join(line.split()) for line in result.stdout.splitlines()]
    assert len(lines) == 10
    assert "1-1 3 - present 0 0403:6001 ttyUSB0 FT232R USB UART, latency 16 ms" in lines


def find(bench: Bench, role: str, said: list[str], timeout: float = 60.0) -> "asyncio.Task[UsbPortConfig]":
    return asyncio.create_task(find_cable(role, bench.machine, said.append, timeout))


def test_the_cable_that_is_pulled_is_found(tmp_path: Path):
    said: list[str] = []

    async def scene(bench: Bench) -> None:
        finding = find(bench, "drive", said)
        await bench.clock.sleep(5)
        bench.usb.unplug("1-1.3")
        await bench.clock.sleep(5)
        assert said[-1] == "plug it in again"
        bench.usb.plug("1-1.3")
        port = await finding
        assert (port.device, port.interface, port.baud, port.usb_id) == ("1-1.3", 0, 38400, "0403:6001")
        assert config_line(port) == 'port: { hub: "1-1", port: 3, baud: 38400, usb_id: "0403:6001" }'

    play(tmp_path, scene, watched=False)
    assert said[1] == "drive: hub 1-1 port 3, 0403:6001 FT232R USB UART"


def test_the_cable_is_named_by_topology_where_the_controller_is_known(tmp_path: Path):
    said: list[str] = []

    async def scene(bench: Bench) -> None:
        serial = bench.machine.sysfs.root / "bus/usb/devices/usb1/serial"
        serial.write_text("0000:00:14.0\n")
        finding = find(bench, "drive", said)
        await bench.clock.sleep(5)
        bench.usb.unplug("1-1.3")
        await bench.clock.sleep(5)
        bench.usb.plug("1-1.3")
        port = await finding
        assert (port.hub, port.port) == ("pci-0000:00:14.0-usb-0:1", 3)
        assert port.at_present(bench.machine.sysfs).device == "1-1.3"
        assert 'hub: "pci-0000:00:14.0-usb-0:1", port: 3' in config_line(port)

    play(tmp_path, scene, watched=False)


def test_a_hub_several_cables_or_a_stick_are_not_taken(tmp_path: Path):
    said: list[str] = []

    async def scene(bench: Bench) -> None:
        bench.usb.add_device("1-2.3", "0781:5567", "Cruzer Blade")
        finding = find(bench, "lidar", said, 20)
        await bench.clock.sleep(1)
        bench.usb.lose_hub("1-1")
        await bench.clock.sleep(1)
        assert "a whole hub disappeared" in said[-1]
        await bench.usb.return_hub("1-1", bench.clock)
        await bench.clock.sleep(1)
        bench.usb.unplug("1-1.1")
        bench.usb.unplug("1-1.2")
        await bench.clock.sleep(1)
        assert "several devices" in said[-1]
        bench.usb.plug("1-1.1")
        bench.usb.unplug("1-2.3")
        await bench.clock.sleep(1)
        assert "not a serial port or camera" in said[-1]
        bench.usb.unplug("1-1.1")
        bench.usb.plug("1-1.1")
        port = await finding
        assert port.device == "1-1.1", "a quick replug counts"

    play(tmp_path, scene, watched=False)


def test_the_search_ends_at_its_time_out(tmp_path: Path):
    said: list[str] = []

    async def scene(bench: Bench) -> None:
        with pytest.raises(NoAnswerError, match="within 30 s"):
            await find(bench, "lidar", said, 30)
        finding = find(bench, "camera", said, 30)
        await bench.clock.sleep(1)
        bench.usb.unplug("1-2.2")
        assert (await finding).device == "1-2.2"
        assert "still not plugged in" in said[-1]

    play(tmp_path, scene, watched=False)


CONFIG = """\
# the truck
devices:
  lidar:   # in front
    port: { path: /dev/truck/lidar }   # by udev
    mount: { x: 0.14 }
  drive:
    port:
      path: /dev/truck/drive
      baud: 57600   # changed by hand

    # node 1
    driver: { kind: epos }
"""


def test_writing_changes_the_port_only(tmp_path: Path):
    file = tmp_path / "truck.yaml"
    file.write_text(CONFIG)
    file.chmod(0o640)
    write_port(file, "lidar", PORTS["lidar"])
    text = file.read_text()
    assert text == CONFIG.replace("{ path: /dev/truck/lidar }", '{ hub: "1-1", port: 1, usb_id: "15d1:0000" }')
    write_port(file, "drive", PORTS["drive"].model_copy(update={"interface": 2}))
    text = file.read_text()
    drive = read_yaml(file)["devices"]["drive"]
    assert drive == {"port": {"hub": "1-1", "port": 3, "interface": 2, "baud": 57600}, "driver": {"kind": "epos"}}
    assert UsbPortConfig.model_validate(drive["port"]).device == "1-1.3"
    for comment in ("# the truck", "# in front", "# by udev", "# node 1"):
        assert comment in text
    write_port(file, "drive", PORTS["compass"])
    assert read_yaml(file)["devices"]["drive"]["port"]["hub"] == "1-2", "once more"
    assert file.stat().st_mode & 0o777 == 0o640
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("devices: { lidar: { driver: {} } }", r"no devices\.lidar\.port"),
        ("devices: [1]", r"no devices\.lidar\.port"),
        ("", r"no devices\.lidar\.port"),
        ("devices: {", "not valid YAML"),
    ],
)
def test_a_file_without_the_place_is_left_alone(tmp_path: Path, text: str, complaint: str):
    file = tmp_path / "truck.yaml"
    file.write_text(text)
    with pytest.raises(InputError, match=complaint):
        write_port(file, "lidar", PORTS["lidar"])
    assert file.read_text() == text


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path):
    with pytest.raises(InputError, match=r"absent\.yaml"):
        write_port(tmp_path / "absent.yaml", "lidar", PORTS["lidar"])


def test_find_port_prints_the_line_and_writes_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    async def found(role: str, machine: Machine, say: Any, timeout: float) -> UsbPortConfig:
        assert (role, timeout) == ("lidar", 5.0)
        assert isinstance(machine.sysfs, Sysfs)
        return PORTS["lidar"]

    monkeypatch.setattr("monstertruckd.tools.cli.find_port.find_cable", found)
    file = tmp_path / "truck.yaml"
    file.write_text(CONFIG)
    result = CliRunner().invoke(app(), ["find-port", "lidar", "--wait", "5", "--write", str(file)])
    assert result.exit_code == 0, result.output
    assert 'port: { hub: "1-1", port: 1, usb_id: "15d1:0000" }' in result.stdout.splitlines()
    assert 'hub: "1-1"' in file.read_text()


@pytest.mark.parametrize("role", ["toaster", "battery"])
def test_find_port_knows_the_roles_there_are(role: str):
    result = CliRunner().invoke(app(), ["find-port", role])
    assert isinstance(result.exception, InputError)
    assert f"no role '{role}'; known: lidar, lidar_2, drive" in str(result.exception)


def test_find_port_asks_nothing_that_it_could_not_write(tmp_path: Path):
    file = tmp_path / "truck.yaml"
    file.write_text("version: 1\n")
    result = CliRunner().invoke(app(), ["find-port", "lidar", "--write", str(file)])
    assert isinstance(result.exception, InputError)
    assert "no devices.lidar.port to replace" in str(result.exception)


def test_a_machine_without_hubs_says_so(monkeypatch: pytest.MonkeyPatch):
    async def nothing(*_: Any) -> tuple[UsbNode, ...]:
        return ()

    monkeypatch.setattr("monstertruckd.tools.cli.usb_tree.local_tree", nothing)
    result = CliRunner().invoke(app(), ["usb", "--local"])
    assert (result.exit_code, result.stdout) == (0, "")
    assert result.stderr == "no USB hub on this machine\n"
    assert json.loads(CliRunner().invoke(app(), ["usb", "--local", "--json"]).stdout) == []
