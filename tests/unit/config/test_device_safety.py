"""Settings of devices: ceilings, and what makes a robot less safe than by default. Every one is decided upon."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from monstertruck_drivers.battery.config import IioConfig, PackConfig
from monstertruck_drivers.epos.config import EposConfig
from monstertruck_drivers.hokuyo_urg.config import HokuyoConfig
from monstertruck_drivers.maestro.config import BatteryInputConfig, MaestroConfig, ServoConfig
from monstertruck_drivers.os4000.config import Os4000Config
from monstertruck_drivers.steppers.config import StepperConfig
from monstertruckd.config.device_safety import WEAKER_ABOVE, WEAKER_BELOW, beyond_devices, unattended_times
from monstertruckd.config.load import load_truck
from monstertruckd.config.truck import TruckConfig
from monstertruckd.gate.config import impossible_settings

CONFIGS = Path(__file__).resolve().parents[3] / "configs"
PLACES = {
    EposConfig: "devices.drive.driver",
    MaestroConfig: "devices.steering.driver",
    HokuyoConfig: "devices.lidar.driver",
    Os4000Config: "devices.compass.driver",
    PackConfig: "devices.steering.driver.battery",
}
UNIT = "what the unit, its mounting or its calibration is"
SEEN = "what then comes late or not at all is stale for the gate, whose own limit counts"
HARMLESS = {
    EposConfig: {
        **dict.fromkeys(("kind", "node", "inverted", "encoder_pulses_per_turn", "motor_type"), UNIT),
        "acceleration_rpm_s": "the gate's ramp is what sets speeds; this one only follows it later",
    },
    StepperConfig: {
        **dict.fromkeys(("kind", "motors", "steps_per_turn", "inverted"), UNIT),
    },
    MaestroConfig: {
        **dict.fromkeys(("kind", "front", "rear", "front_right", "rear_right", "device_number", "use_crc"), UNIT),
        **dict.fromkeys(("dead_time", "lag"), "measured; by default they are not"),
        "battery": "decided upon below; null is named",
        "deadman_channel": "what is wired; by default nothing is",
        "deadman_feed": "named, if it is always",
    },
    ServoConfig: {
        **dict.fromkeys(("channel", "centre_us", "scale_us_per_deg", "direction", "min_us", "max_us"), UNIT),
        "max_angle_deg": UNIT,
        **dict.fromkeys(
            ("speed", "acceleration"), "gate.steering_rate is what sets angles; this only follows it later"
        ),
    },
    HokuyoConfig: {
        **dict.fromkeys(("kind", "frame", "serial_number"), UNIT),
        "scan_format": "both see farther than the gate looks",
        "cluster": "the nearest of neighbouring ranges is kept",
        **dict.fromkeys(
            ("max_bad_scans", "stale_periods", "first_scan_periods", "line_timeout", "verify_timeout"), SEEN
        ),
        "hidden": "outside the field of view: the gate stops before this ground, ahead as in reverse",
        "clock_samples": "stamps later than gate.max_latency are not valid",
    },
    Os4000Config: {
        **dict.fromkeys(("kind", "fields", "iron", "frame"), UNIT),
        "field_strength": "by default it is not known",
        **dict.fromkeys(("rate", "silence"), SEEN),
    },
    PackConfig: {
        **dict.fromkeys(("cells", "capacity_ah"), UNIT),
        "resistance": "measured; max_compensation bounds what it explains",
        "smoothing": "of what is shown; limits are compared with what is measured",
        "plausible_min": "what reads less is a fault, what reads more is critical: both limit",
    },
    BatteryInputConfig: dict.fromkeys(("channel", "current", "volts_per_count", "gain", "offset"), UNIT),
    IioConfig: {
        **dict.fromkeys(("kind", "device", "channel", "divider", "offset", "full_scale"), UNIT),
        "rate": "what is not measured for 2 s is slow",
    },
}
"""Settings that make no robot less safe, with the reason."""


def truck(name: str = "", value: Any = None) -> TruckConfig:
    """The whole truck at the default limits, with one setting of another value."""
    data = load_truck(CONFIGS / "full.yaml")[0].model_dump()
    if name:
        *sections, key = name.split(".")
        place = data
        for section in sections:
            place = place[section]
        assert key in place
        place[key] = value
    return TruckConfig.model_validate(data, strict=False)


def refusals(config: TruckConfig, **changes: Any) -> list[str]:
    """What is beyond the robot, with another body or other monitors."""
    body, monitors = changes.get("body", config.body_limits), changes.get("monitors", config.monitors)
    found = impossible_settings(config.gate, body, unattended_times(config.devices))
    return [*found, *beyond_devices(config.devices, monitors, config.gate.standstill, body)]


@pytest.mark.parametrize("model", HARMLESS)
def test_no_setting_is_forgotten(model):
    inherited = set(PackConfig.model_fields) if model in (BatteryInputConfig, IioConfig) else set()
    decided = [*WEAKER_ABOVE.get(model, ()), *WEAKER_BELOW.get(model, ()), *HARMLESS[model]]
    assert len(set(decided)) == len(decided)
    assert set(decided) == set(model.model_fields) - inherited


def test_the_defaults_weaken_nothing():
    assert truck().weakened() == ()


ABOVE = [(model, name) for model, names in WEAKER_ABOVE.items() if model in PLACES for name in names]
BELOW = [(model, name) for model, names in WEAKER_BELOW.items() if model in PLACES for name in names]


def unchecked(name: str, value: Any) -> TruckConfig:
    """The same, whatever the thresholds of a pack must be to each other."""

    def changed(model: Any, path: list[str]) -> Any:
        key, *rest = path
        return model.model_copy(update={key: changed(getattr(model, key), rest) if rest else value})

    return changed(truck(), name.split("."))


@pytest.mark.parametrize(("model", "name"), ABOVE)
def test_more_of_it_is_weaker(model, name):
    usual = getattr(model(), name)
    path = f"{PLACES[model]}.{name}"
    more, less = (usual + 1, usual - 1) if isinstance(usual, int) else (usual * 1.01, usual * 0.99)
    assert unchecked(path, more).weakened() == (f"{path} {more:g}, default {usual:g}",)
    assert unchecked(path, less).weakened() == ()


@pytest.mark.parametrize(("model", "name"), BELOW)
def test_less_of_it_is_weaker(model, name):
    usual = getattr(model(), name)
    path = f"{PLACES[model]}.{name}"
    assert unchecked(path, usual * 0.99).weakened() == (f"{path} {usual * 0.99:g}, default {usual:g}",)
    assert unchecked(path, usual * 1.01).weakened() == ()


@pytest.mark.parametrize(("model", "name"), ABOVE)
def test_whatever_weakens_has_a_ceiling(model, name):
    with pytest.raises(ValueError, match=r"at most|less than|expected .* <|not plausible"):
        truck(f"{PLACES[model]}.{name}", 10**9)


@pytest.mark.parametrize("name", ["low", "critical", "collapsed"])
def test_cells_have_nothing_left_below_three_volts(name):
    for volts, found in ((18.0, []), (17.99, [f"devices.steering.driver.battery.{name} 17.99 V: at least 18"])):
        config = unchecked(f"devices.steering.driver.battery.{name}", volts)
        refused = refusals(config)
        assert [text.partition(",")[0] for text in refused] == found


@pytest.mark.parametrize(
    ("name", "most", "text"),
    [
        ("devices.steering.driver.battery.plausible_max", 27.0, "at most 27, of 6 cells"),
        ("devices.steering.driver.battery.max_compensation", 3.0, "at most 3, of 6 cells"),
        ("devices.drive.driver.standstill_rpm", 820, "at most 820, gate.standstill"),
        ("devices.drive.driver.command_timeout", 0.47 / 0.21, "at most 2.24 s, the time to travel the robot's length"),
        ("devices.drive.driver.quick_stop_after", 0.47 / 0.21, "at most 2.24 s"),
        ("devices.drive.driver.status_period", 0.47 / 0.21, "at most 2.24 s"),
        ("devices.steering.driver.command_timeout", 0.47 / 0.21, "at most 2.24 s"),
    ],
)
def test_a_ceiling_itself_is_allowed(name, most, text):
    for value, found in ((most, False), (most + (1 if isinstance(most, int) else 1e-3), True)):
        config = unchecked(name, value)
        refused = refusals(config)
        assert any(one.startswith(f"{name} {value:g}") and text in one for one in refused) is found, refused


def test_a_motor_of_unknown_rate_has_no_ceiling_of_its_own():
    config = unchecked("devices.drive.driver.standstill_rpm", 10**6)
    unknown = dataclasses.replace(config.body_limits, motor_speed=None)
    assert refusals(config, body=unknown) == []


def test_the_thresholds_of_a_smaller_pack_are_compared_cell_by_cell():
    usual = PackConfig()
    names = ("low", "clear", "critical", "collapsed", "overcharged", "overcharged_clear")
    three = {name: getattr(usual, name) / 2 for name in (*names, "plausible_min", "plausible_max", "max_compensation")}
    pack = truck().devices.steering.driver.battery.model_copy(update={"cells": 3, **three})
    assert unchecked("devices.steering.driver.battery", pack).weakened() == ()
    low = pack.model_copy(update={"critical": 10.4})
    assert unchecked("devices.steering.driver.battery", low).weakened() == (
        "devices.steering.driver.battery.critical 10.4, default 10.5",
    )


def test_a_battery_measured_by_the_computer_is_judged_alike():
    config = unchecked("devices.steering.driver.battery", None)
    weak = config.model_copy(update={"monitors": config.monitors.model_copy(update={"battery": IioConfig(low=21.5)})})
    assert weak.weakened() == ("monitors.battery.low 21.5, default 22",)
    low = IioConfig.model_construct(**(IioConfig().model_dump() | {"collapsed": 17.0}))
    monitors = config.monitors.model_copy(update={"battery": low})
    (refused,) = refusals(config, monitors=monitors)
    assert refused.startswith("monitors.battery.collapsed 17 V: at least 18")


def test_a_battery_that_nothing_measures_and_a_line_that_is_always_up_are_named():
    assert unchecked("devices.steering.driver.battery", None).weakened() == (
        "devices.steering.driver.battery null: an empty battery is not noticed",
    )
    assert unchecked("devices.steering.driver.deadman_feed", "always").weakened() == (
        "devices.steering.driver.deadman_feed always: the deadman line guards against a dead process only",
    )
