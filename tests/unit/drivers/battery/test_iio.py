"""Readings of the converter's files: what they mean, and what may be wrong with them."""

import errno
from pathlib import Path

import pytest

from monstertruck_drivers.battery import iio
from monstertruck_drivers.catalog import DEVICES
from monstertruck_runtime.clock import WallClock
from monstertruck_runtime.errors import (
    DeviceError,
    DeviceLostError,
    DeviceMismatchError,
    DeviceTimeoutError,
    PortBusyError,
    ProtocolError,
)
from tests.unit.drivers.kit import emulated_computer


def converter(root: Path, number: int = 0, name: str = "ads1015", **files: str) -> Path:
    folder = root / f"iio:device{number}"
    folder.mkdir(parents=True)
    (folder / "name").write_text(f"{name}\n")
    for file, text in files.items():
        (folder / file).parent.mkdir(exist_ok=True)
        (folder / file).write_text(f"{text}\n")
    return folder


def test_scale_and_offset_of_the_channel_go_before_those_of_all(tmp_path: Path):
    converter(
        tmp_path, in_voltage0_raw="1000", in_voltage1_raw="1000", in_voltage1_scale="3", in_voltage_scale="2",
        in_voltage0_offset="-100", in_voltage_offset="7",
    )  # fmt: skip
    found = iio.find(tmp_path, "")
    first, second = iio.channel(found, 0), iio.channel(found, 1)
    assert first.volts(first.read()) == pytest.approx((1000 - 100) * 2 / 1000)
    assert second.volts(second.read()) == pytest.approx((1000 + 7) * 3 / 1000)


@pytest.mark.parametrize(
    ("kind", "full"), [("be:u12/16>>0", 4095), ("le:s12/16>>4", 2047), ("be:u10/16X2>>2", 1023), ("nonsense", None)]
)
def test_the_full_scale_comes_from_the_scan_element(tmp_path: Path, kind: str, full: int | None):
    folder = converter(tmp_path, in_voltage0_raw="1", in_voltage_scale="1")
    (folder / "scan_elements").mkdir()
    (folder / "scan_elements" / "in_voltage0_type").write_text(kind)
    assert iio.channel(iio.find(tmp_path, ""), 0).full_scale == full
    assert iio.channel(iio.find(tmp_path, ""), 0, full_scale=500).full_scale == 500


def test_both_ends_of_the_scale_are_limits(tmp_path: Path):
    converter(tmp_path, in_voltage0_raw="1", in_voltage_scale="1")
    known = iio.channel(iio.find(tmp_path, ""), 0, full_scale=2047)
    assert [known.at_limit(raw) for raw in (-1, 0, 1, 2046, 2047)] == [True, True, False, False, True]
    assert not iio.channel(iio.find(tmp_path, ""), 0).at_limit(10**6)


def test_a_converter_is_found_by_name_or_because_it_is_alone(tmp_path: Path):
    with pytest.raises(DeviceLostError, match="no converter at all; found: none"):
        iio.find(tmp_path, "")
    converter(tmp_path, 0, "accel", in_accel_x_raw="1")
    converter(tmp_path, 1, "ads1015", in_voltage0_raw="1")
    assert iio.find(tmp_path, "").name == "ads1015"
    converter(tmp_path, 2, "mcp3208", in_voltage0_raw="1")
    with pytest.raises(DeviceMismatchError, match="ads1015, mcp3208; select one"):
        iio.find(tmp_path, "")
    assert iio.find(tmp_path, "mcp3208").path.name == "iio:device2"
    with pytest.raises(DeviceLostError, match="no converter max1363"):
        iio.find(tmp_path, "max1363")


def test_differential_inputs_are_no_channels(tmp_path: Path):
    converter(tmp_path, **{"in_voltage0-voltage1_raw": "5", "in_voltage3_raw": "5"})
    assert iio.find(tmp_path, "").channels() == [3]


@pytest.mark.parametrize(
    ("files", "text"),
    [({"in_voltage1_raw": "1"}, r"no channel 0; available: \[1\]"), ({"in_voltage0_raw": "1"}, "has scale None")],
)
def test_a_channel_that_cannot_be_read_is_a_mismatch(tmp_path: Path, files: dict[str, str], text: str):
    converter(tmp_path, **files)
    with pytest.raises(DeviceMismatchError, match=text):
        iio.channel(iio.find(tmp_path, ""), 0)


@pytest.mark.parametrize(
    ("code", "kind"),
    [
        (errno.ENODEV, DeviceLostError),
        (errno.ENOENT, DeviceLostError),
        (errno.EBUSY, PortBusyError),
        (errno.EREMOTEIO, DeviceTimeoutError),
        (errno.ETIMEDOUT, DeviceTimeoutError),
        (errno.EACCES, DeviceError),
    ],
)
def test_errors_of_the_kernel(monkeypatch: pytest.MonkeyPatch, code: int, kind: type[DeviceError]):
    def fail(*_: object, **__: object) -> str:
        raise OSError(code, "as injected")

    monkeypatch.setattr(Path, "read_text", fail)
    with pytest.raises(kind, match="as injected") as caught:
        iio.read_text(Path("in_voltage0_raw"))
    assert type(caught.value) is kind


def test_garbage_is_no_number(tmp_path: Path):
    converter(tmp_path, in_voltage0_raw="-", in_voltage_scale="1")
    with pytest.raises(ProtocolError, match="expected a number, got '-'"):
        iio.channel(iio.find(tmp_path, ""), 0).read()


async def test_the_probe_lists_readings_and_what_is_wrong(tmp_path: Path):
    converter(tmp_path / iio.CONVERTERS, in_voltage0_raw="500", in_voltage_scale="2", in_voltage3_raw="-")
    found = await DEVICES["iio"].identify(emulated_computer(tmp_path, WallClock()), WallClock())
    (one,) = found["converters"]
    assert one["name"] == "ads1015"
    good, bad = one["channels"]
    assert (good["channel"], good["raw"], good["volts"]) == (0, 500, 1.0)
    assert bad["channel"] == 3
    assert "expected a number" in bad["error"]
