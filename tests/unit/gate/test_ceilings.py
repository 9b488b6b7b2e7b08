"""Ceilings that no configuration exceeds, and the settings that make a robot less safe than by default."""

from pathlib import Path

import pytest

from monstertruck_runtime.plugins import models_in
from monstertruckd.config.load import load_truck
from monstertruckd.config.truck import TruckConfig
from monstertruckd.gate.config import (
    WEAKER_ABOVE,
    WEAKER_BELOW,
    BodyLimits,
    GateConfig,
    impossible_settings,
    stopping_distance,
    weakened,
)

CONFIGS = Path(__file__).resolve().parents[3] / "configs"
BODY = BodyLimits(length=0.47, mass=7.25, pull=25.0, motor_speed=0.2196, sight=3.9)
STRONG = BodyLimits(length=2.0, mass=10.0, pull=500.0, motor_speed=9.0, sight=3.9)
ACCELERATIONS = ("acceleration", "deceleration", "quick_deceleration")
TIMES = (
    *(f"{sensor}.stale_after" for sensor in ("scan", "drive", "steering", "attitude")),
    *(f"leases.{role}" for role in ("gamepad", "keyboard", "station", "tracker")),
    "blocked.within",
    *("max_latency", "reaction", "tick_stall", "max_request_age"),
)
APART = {
    *(f"{sensor}.critical" for sensor in ("scan", "drive", "steering", "attitude")),
    *("tolerated_failures", "remote_trackers", "obstacle.open_ground", "obstacle.unseen"),
}
"""Settings that are no figures, with a text of their own where they weaken."""
HARMLESS = {
    "obstacle.confirmed_speed": "its model allows no more than the default",
    "battery.critical": "a battery that is not measured is slow in any case; critical stops the truck as well",
    "assist.on": "all checks of the gate see the turned motion",
    "assist.horizon": "likewise",
    "event_interval": "events that are left out are in state/gate and in the stops",
}
AS_THE_SPEED = {
    "tilt.slow_speed": "above gate.speed it is no limit, and named; a slow robot has the defaults above its speed",
    "battery_low_speed": "likewise",
    "obstacle.unseen_speed": "likewise",
    "sonar.unseen_speed": "likewise",
}
"""Settings that are weaker the greater they are, and have no ceiling of their own, with the reason."""


def refusals(body=BODY, **config):
    return list(impossible_settings(GateConfig(**config), body))


def test_the_defaults_are_within_all_ceilings_and_weaken_nothing():
    assert refusals() == []
    assert weakened(GateConfig()) == ()


@pytest.mark.parametrize(
    ("config", "expected"),
    [
        ({"speed": 0.23}, "gate.speed 0.23 m/s: at most 0.220, the speed at the motor's maximum rate"),
        ({"reverse_speed": 0.22}, "gate.reverse_speed 0.22 m/s: at most gate.speed, 0.21"),
        ({"acceleration": 3.5}, "gate.acceleration 3.5 m/s^2: at most 3.45, the acceleration by 25 N"),
        ({"deceleration": 3.5, "quick_deceleration": 3.5}, "gate.deceleration 3.5 m/s^2: at most 3.45"),
        ({"quick_deceleration": 3.5}, "gate.quick_deceleration 3.5 m/s^2: at most 3.45"),
        ({"scan": {"stale_after": 2.3}}, "gate.scan.stale_after 2.3 s: at most 2.24 s"),
        ({"drive": {"stale_after": 2.3}}, "gate.drive.stale_after 2.3 s: at most 2.24 s"),
        ({"steering": {"stale_after": 2.3, "critical": False}}, "gate.steering.stale_after 2.3 s"),
        ({"attitude": {"stale_after": 2.3}}, "gate.attitude.stale_after 2.3 s"),
        ({"max_latency": 2.3}, "gate.max_latency 2.3 s"),
        ({"reaction": 2.3}, "gate.reaction 2.3 s"),
        ({"tick_stall": 2.3}, "gate.tick_stall 2.3 s"),
        ({"max_request_age": 2.3}, "gate.max_request_age 2.3 s"),
        ({"blocked": {"within": 2.3}}, "gate.blocked.within 2.3 s"),
        ({"turning": {"speed": 0.21}}, "gate.turning.speed 0.21 m/s: expected less than gate.speed, 0.21"),
        ({"blocked": {"speed": 0.21}}, "gate.blocked.speed 0.21 m/s: expected less than gate.speed, 0.21"),
        ({"obstacle": {"deceleration": 1.01}}, "gate.obstacle.deceleration 1.01 m/s^2: at most gate.deceleration, 1"),
        ({"tilt": {"stop": 0.541}}, "gate.tilt.stop 0.541 rad: at most 0.540, where the wheels slip"),
    ],
)
def test_what_a_body_cannot_do_is_refused_by_name(config, expected):
    assert refusals(**config)[0].startswith(expected)


@pytest.mark.parametrize(
    ("name", "limit"), [("speed", BODY.motor_speed), *((name, BODY.acceleration) for name in ACCELERATIONS)]
)
def test_a_ceiling_is_still_within_it_up_to_rounding(name, limit):
    unchecked = GateConfig().model_copy
    for excess, found in ((0.0, []), (1e-9, []), (1.5e-9, [f"gate.{name}"])):
        refused = impossible_settings(unchecked(update={name: limit + excess}), BODY)
        assert [text.split()[0] for text in refused] == found


@pytest.mark.parametrize("name", TIMES)
def test_a_time_is_at_most_that_of_its_own_length(name):
    body = BodyLimits(length=0.5, mass=7.25, pull=25.0, motor_speed=None, sight=1e3)
    for seconds, found in ((2.0, []), (2.0001, [f"gate.{name}"])):
        config = GateConfig(speed=0.25)
        section, _, key = name.rpartition(".")
        update = {section: getattr(config, section).model_copy(update={key: seconds})} if section else {key: seconds}
        assert [text.split()[0] for text in impossible_settings(config.model_copy(update=update), body)] == found


def test_the_distance_to_standstill_and_the_speed_in_reverse_may_be_as_much_as_their_limits():
    config = GateConfig(reverse_speed=0.21)
    needed = stopping_distance(config)
    assert list(impossible_settings(config, BodyLimits(0.47, 7.25, 25.0, None, needed))) == []
    assert len(list(impossible_settings(config, BodyLimits(0.47, 7.25, 25.0, None, needed - 1e-9)))) == 1
    assert list(impossible_settings(config, BodyLimits(needed, 7.25, 25.0, None, None))) == []


def test_a_fast_truck_must_stop_within_what_its_lidar_sees():
    fast = {"speed": 2.0, "reverse_speed": 0.5}
    assert stopping_distance(GateConfig(**fast)) == pytest.approx(0.05 + 2.0 * (0.25 + 0.4 + 0.08) + 2.0)
    assert refusals(STRONG, **fast) == []
    (refusal,) = refusals(STRONG, **(fast | {"speed": 2.2}))
    assert "stops within 4.08 m: at most 3.90 m, the lidar's reliable range" in refusal
    blind = BodyLimits(length=2.0, mass=10.0, pull=500.0, motor_speed=9.0, sight=None)
    (refusal,) = refusals(blind, **fast)
    assert "at most 2.00 m, its own length, as it has no lidar" in refusal


def test_wheels_hold_no_more_than_their_grip_however_strong_the_motor():
    assert STRONG.acceleration == pytest.approx(0.6 * 9.81)
    assert BODY.acceleration == pytest.approx(25 / 7.25)


def test_a_motor_of_unknown_rate_has_no_ceiling_of_its_own():
    assert refusals(BodyLimits(0.47, 7.25, 25.0, None, 3.9), speed=0.5) == []


@pytest.mark.parametrize("name", WEAKER_ABOVE)
def test_more_of_it_is_weaker(name):
    assert any(text.startswith(f"gate.{name} ") for text in changed(name, 1.01))
    assert changed(name, 0.99) == ()


@pytest.mark.parametrize("name", WEAKER_BELOW)
def test_less_of_it_is_weaker(name):
    assert any(text.startswith(f"gate.{name} ") for text in changed(name, 0.99))
    assert changed(name, 1.01) == ()


def changed(name, factor):
    """What is weaker with one setting multiplied; unchecked, as the defaults depend on each other."""
    config, *path = GateConfig(), *name.split(".")
    section = config if len(path) == 1 else getattr(config, path[0])
    value = getattr(section, path[-1]) * factor
    section = section.model_copy(update={path[-1]: value})
    return weakened(section if len(path) == 1 else config.model_copy(update={path[0]: section}))


@pytest.mark.parametrize("sensor", ["scan", "drive", "steering", "attitude"])
def test_every_sensor_that_may_be_silent_is_named(sensor):
    section = getattr(GateConfig(), sensor).model_copy(update={"critical": False})
    (text,) = weakened(GateConfig().model_copy(update={sensor: section}))
    assert text.startswith(f"gate.{sensor}.critical false")


def leaves(model, prefix=""):
    """Dotted names of all settings of a model, through its sections."""
    for name, field in model.model_fields.items():
        section = next((kind for kind in models_in(field)), None)
        yield from [prefix + name] if section is None else leaves(section, f"{prefix}{name}.")


def test_no_setting_is_forgotten():
    """A new one is decided upon: does it weaken, and in which direction."""
    decided = [*WEAKER_ABOVE, *WEAKER_BELOW, *APART, *HARMLESS]
    assert sorted(decided) == sorted(set(decided))
    assert set(decided) == set(leaves(GateConfig))
    assert all(getattr(GateConfig(), name) is not None for name in ("turning", "blocked")), "null weakens, by a text"


def nested(name, value):
    for part in reversed(name.split(".")):
        value = {part: value}
    return value


@pytest.mark.parametrize("name", [name for name in WEAKER_ABOVE if name not in AS_THE_SPEED])
def test_whatever_weakens_has_a_ceiling(name):
    with pytest.raises(ValueError, match=name.rpartition(".")[2]):
        truck(**nested(name, 10**9))


@pytest.mark.parametrize("name", AS_THE_SPEED)
def test_a_limit_above_the_speed_is_none_and_named(name):
    assert [text for text in truck(**nested(name, 5.0)).weakened() if text.startswith(f"gate.{name} 5")]


def test_sensors_checks_and_services_that_are_switched_off_are_named():
    config = GateConfig(
        scan={"stale_after": 0.25, "critical": False},
        attitude=None,
        turning=None,
        blocked=None,
        runaway=None,
        obstacle={"open_ground": True},
        tolerated_failures=("camera", "slam"),
        remote_trackers=("desk",),
    )
    assert weakened(config) == (
        "gate.scan.critical false: a silent sensor does not stop the robot",
        "gate.attitude null: no slope stops the robot, and servos without supply are not noticed",
        "gate.turning null: servos without supply are not noticed",
        "gate.blocked null: a blocked shaft is not noticed",
        "gate.runaway null: a motor that does not obey is not noticed",
        "gate.obstacle.open_ground true: a scan without any range is treated as free ground",
        "gate.tolerated_failures: slam may fail while the robot drives",
        "gate.remote_trackers: desk may drive from outside",
    )


def truck(**gate):
    config, _ = load_truck(CONFIGS / "truck.yaml")
    return TruckConfig.model_validate(config.model_dump() | {"gate": gate}, strict=False)


@pytest.mark.parametrize(
    "gate",
    [{"speed": 100.0}, {"scan": {"stale_after": 1e9, "critical": False}}, {"drive": {"stale_after": 10.0}}],
)
def test_a_truck_so_configured_is_refused(gate):
    with pytest.raises(ValueError, match="gate"):
        truck(**gate)


def test_an_attitude_that_is_measured_keeps_its_limits():
    with pytest.raises(ValueError, match=r"gate\.attitude null: a device measures the attitude"):
        truck(attitude=None)


@pytest.mark.parametrize(
    ("driver", "seen"),
    [
        ({"kind": "hokuyo_urg"}, 4.0),
        ({"kind": "hokuyo_lx"}, 4.0),
        ({"kind": "hokuyo_lx", "model": "ust_20lx"}, 8.0),
        ({"kind": "rplidar", "model": "c1"}, 6.0),
        ({"kind": "rplidar", "model": "a1"}, 12.0),
        ({"kind": "ld19"}, 12.0),
    ],
)
def test_how_far_a_robot_sees_is_on_its_lidars_data_sheet(driver, seen):
    config, _ = load_truck(CONFIGS / "truck.yaml")
    lidar = config.devices.lidar.model_dump() | {"driver": driver}
    devices = config.devices.model_dump() | {"lidar": lidar}
    limits = TruckConfig.model_validate(config.model_dump() | {"devices": devices}, strict=False).body_limits
    assert limits.sight == pytest.approx(seen - 0.235 + 0.14)


def test_a_truck_knows_its_limits_and_what_weakens_it():
    config = truck()
    limits = config.body_limits
    assert limits.motor_speed == pytest.approx(0.2195, abs=1e-4)
    assert limits.sight == pytest.approx(4.0 - 0.235 + 0.14)
    assert config.weakened() == ()
    weak = truck(scan={"stale_after": 0.5})
    opened = {"listen": ("tcp/0.0.0.0:7447",), "connect": ("tcp/10.0.0.1:7447",), "insecure": True}
    assert weak.model_copy(update={"zenoh": config.zenoh.model_copy(update=opened)}).weakened() == (
        "gate.scan.stale_after 0.5, default 0.25",
        "zenoh.insecure: anyone who can reach tcp/0.0.0.0:7447 may drive",
        "zenoh.insecure: anyone who can reach tcp/10.0.0.1:7447 may drive",
    )
