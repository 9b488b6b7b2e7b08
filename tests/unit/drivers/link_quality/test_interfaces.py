"""The kernel's texts, in every form it prints them."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from monstertruck_drivers.catalog import DEVICES
from monstertruck_drivers.link_quality.emulator import HEADER, NetworkEmulator
from monstertruck_drivers.link_quality.interfaces import Signal, choose, parse_wireless, read_interfaces
from monstertruck_runtime.clock import WallClock
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.health import LinkMedium
from tests.unit.drivers.kit import emulated_computer


@pytest.mark.parametrize(
    ("row", "expected"),
    [
        (" wlan0: 0000   54.  -56.  -256        0      0      0      0     42        0", Signal(-56.0, None)),
        (" wlan0: 0000   54   -56   -95         0      0      0      0     42        0", Signal(-56.0, -95.0)),
        (" wlan0: 0000   54.  200.  161.        0      0      0      0     42        0", Signal(-56.0, -95.0)),
        (" wlan0: 0000    0     0     0         0      0      0      0      0        0", Signal(None, None)),
        ("wlan0:0000 70. -30. -256 0 0 0 0 0 0", Signal(-30.0, None)),
    ],
)
def test_rows(row: str, expected: Signal):
    assert parse_wireless(HEADER + row + "\n") == {"wlan0": expected}


@pytest.mark.parametrize(
    "text", ["", HEADER, HEADER + " wlan0: 0000\n", HEADER + " wlan0: 0000 x y z\n", "no colon 1 2 3 4"]
)
def test_what_is_no_row_is_skipped(text: str):
    assert parse_wireless(text) == {}


@settings(max_examples=100)
@given(st.text(max_size=200))
def test_any_text_is_survived(text: str):
    for name, signal in parse_wireless(text).items():
        assert name == name.strip()
        assert signal.level != 0


def test_wifi_and_cable_are_seen_and_nothing_else(tmp_path: Path):
    emulator = NetworkEmulator(tmp_path, WallClock())
    emulator.inject("cable", "on")
    cable, wifi = read_interfaces(tmp_path)
    assert (cable.name, cable.medium, cable.connected, cable.bit_rate) == ("eth0", LinkMedium.ETHERNET, True, 1e9)
    assert (wifi.name, wifi.medium, wifi.connected, wifi.signal) == (
        "wlan0",
        LinkMedium.WIFI,
        True,
        Signal(-55.0, None),
    )
    assert wifi.errors == 3


def test_a_virtual_interface_is_left_out(tmp_path: Path):
    folder = tmp_path / "sys/class/net/docker0"
    folder.mkdir(parents=True)
    (folder / "type").write_text("1")
    assert read_interfaces(tmp_path) == []


def test_the_choice(tmp_path: Path):
    emulator = NetworkEmulator(tmp_path, WallClock())

    def chosen(name: str | None = None) -> str | None:
        sample = choose(read_interfaces(tmp_path), name)
        return sample.name if sample else None

    emulator.inject("cable", "on")
    assert chosen() == "wlan0", "Wi-Fi first"
    emulator.inject("wifi", "off")
    assert chosen() == "eth0", "but connected before that"
    emulator.inject("cable", "off")
    assert chosen() == "wlan0"
    emulator.inject("remove")
    assert chosen() == "eth0"
    assert chosen("wlan0") is None
    assert choose([], None) is None


async def test_the_probe(tmp_path: Path):
    NetworkEmulator(tmp_path, WallClock())
    found = await DEVICES["link_quality"].identify(emulated_computer(tmp_path, WallClock()), WallClock())
    assert found["chosen"] == "wlan0"
    assert [row["name"] for row in found["interfaces"]] == ["eth0", "wlan0"]


def test_unknown_faults_are_refused_with_a_list(tmp_path: Path):
    emulator = NetworkEmulator(tmp_path, WallClock())
    for fault in (("explode",), ("signal", "x"), ("style", "odd")):
        with pytest.raises(InputError, match="known: signal"):
            emulator.inject(*fault)
