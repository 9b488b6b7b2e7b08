"""The gate's settings: the values a truck is delivered with, and which of them contradict each other."""

import pytest

from monstertruck_schemas.req import Role
from monstertruckd.gate.config import GateConfig, Leases

DELIVERED = {
    "rate": 50.0,
    "speed": 0.21,
    "reverse_speed": 0.15,
    "angle": 0.436,
    "acceleration": 0.5,
    "deceleration": 1.0,
    "quick_deceleration": 1.2,
    "steering_rate": 1.0,
    "reaction": 0.08,
    "standstill": 0.01,
    "leases": {"hand": 0.25, "gamepad": 0.25, "keyboard": 0.25, "station": 0.25, "tracker": 0.25},
    "max_request_age": 0.5,
    "remote_trackers": (),
    "disarm_after": 1.5,
    "scan": {"stale_after": 0.25, "critical": True},
    "scan_tilt": 0.35,
    "drive": {"stale_after": 0.2, "critical": True},
    "steering": {"stale_after": 0.25, "critical": True},
    "attitude": {"stale_after": 0.25, "critical": True},
    "battery": {"stale_after": 2.0, "critical": False},
    "max_latency": 0.4,
    "tolerated_failures": ("recorder", "camera", "link", "host", "usb", "stalls"),
    "tick_stall": 0.15,
    "stall_dwell": 0.5,
    "tilt": {"slow": 0.21, "stop": 0.35, "hysteresis": 0.035, "slow_speed": 0.08},
    "turning": {"window": 2.0, "tolerance": 0.14, "speed": 0.03, "share": 0.3},
    "blocked": {"within": 0.6, "speed": 0.03, "share": 0.1},
    "short_faults": 4,
    "short_faults_within": 10.0,
    "battery_low_speed": 0.1,
    "assist": {"on": False, "horizon": 0.6},
    "obstacle": {
        "ahead": 0.05,
        "side_clearance": 0.02,
        "deceleration": 0.15,
        "crawl": 0.02,
        "seen": 0.5,
        "unseen_speed": 0.1,
        "unseen": "stop",
        "confirmed_speed": 0.05,
        "memory_time": 30.0,
        "memory_distance": 2.0,
        "memory_deviation": 0.1,
        "open_ground": False,
    },
    "contact": {"rise": 1.0, "rolling": 0.25, "share": 0.3, "within": 0.15, "back_off": 0.03},
    "runaway": {"distance": 0.01, "body_distance": 0.03, "idle_current": 0.05},
    "docking": {"speed": 0.05, "across": 0.15, "turn": 0.3, "beyond": 0.02},
    "sonar": {"stale_after": 0.3, "core": 0.2, "unseen_speed": 0.1},
    "yaw_acceleration": 6.0,
    "unwitnessed": 0.5,
    "event_interval": 1.0,
}


def test_the_settings_as_delivered():
    assert GateConfig().model_dump() == DELIVERED


def test_a_sensor_of_which_nothing_is_said_stops_the_truck():
    assert GateConfig.model_validate({"battery": {"stale_after": 1.0}}).battery.critical


def test_every_driving_role_has_its_own_lease():
    leases = Leases(hand=0.05, gamepad=0.1, keyboard=0.2, station=0.3, tracker=0.4)
    assert [leases.of(role) for role in (Role.HAND, Role.GAMEPAD, Role.KEYBOARD, Role.STATION, Role.TRACKER)] == [
        0.05,
        0.1,
        0.2,
        0.3,
        0.4,
    ]


@pytest.mark.parametrize(
    ("last", "beyond", "hint"),
    [
        ({"quick_deceleration": 1.0}, {"quick_deceleration": 0.999}, "quick_deceleration"),
        ({"tick_stall": 0.0201}, {"tick_stall": 0.02}, "tick_stall 0.02 s: expected more than one tick, 0.02 s"),
        ({"rate": 10.0}, {"rate": 10.0, "tick_stall": 0.1}, "tick_stall"),
        (
            {"standstill": 0.02},
            {"standstill": 0.021},
            "standstill 0.021 m/s: expected at most obstacle.crawl, 0.02 m/s",
        ),
        ({"obstacle": {"crawl": 0.209}}, {"obstacle": {"crawl": 0.21}}, "crawl 0.21 m/s: expected less than speed"),
        (
            {"short_faults_within": 4.0},
            {"short_faults_within": 3.9},
            "short_faults_within 3.9 s: expected at least one second",
        ),
        (
            {"leases": {"tracker": 0.9}, "disarm_after": 0.91},
            {"leases": {"tracker": 0.9}, "disarm_after": 0.9},
            "disarm_after 0.9 s: expected more than every lease",
        ),
        ({"tilt": {"hysteresis": 0.2}}, {"tilt": {"hysteresis": 0.21}}, "hysteresis < slow < stop"),
        ({"tilt": {"slow": 0.349}}, {"tilt": {"slow": 0.35}}, "hysteresis < slow < stop"),
    ],
)
def test_a_contradiction_is_refused_at_its_very_limit(last, beyond, hint):
    GateConfig.model_validate(last)
    with pytest.raises(ValueError, match=hint):
        GateConfig.model_validate(beyond)
