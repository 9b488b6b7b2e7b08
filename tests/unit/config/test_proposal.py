"""Calibration that a tracker proposes: right, kept, void on another one, over once the steering is calibrated."""

import math
from pathlib import Path

import numpy as np
import pytest

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.plan import AxleDeviation, TrackerState
from monstertruck_schemas.reasons import Reason
from monstertruckd.config.calibration import CalibrationStore, with_values
from monstertruckd.config.load import load_config
from monstertruckd.config.proposal import SteeringProposal
from monstertruckd.config.truck import TruckConfig

TRUCK = load_config(Path(__file__).resolve().parents[3] / "configs" / "truck.yaml", TruckConfig)[0]
DATE = "2026-01-01T00:00:00Z"


def row(axle="front", gain=0.9, trim=0.04, *, servo=True):
    return AxleDeviation(
        axle=axle, gain=gain, gain_deviation=0.01, trim=trim, trim_deviation=0.003, slip=0.0, slip_deviation=0.01,
        samples=40, servo_differs=servo,
    )  # fmt: skip


def state(*rows):
    return TrackerState(
        stamp=0, received=0, seq=0, cross_track=0.0, heading_error=0.0, along=0.0, length=1.0, outcome=Reason.DRIVING,
        steering=rows, steering_differs="front steers less",
    )  # fmt: skip


def proposal(file=None, base="0001.json", config=TRUCK):
    return SteeringProposal(config, base, file)


@pytest.mark.parametrize("axle", ["front", "rear"])
@pytest.mark.parametrize(("gain", "trim"), [(0.9, 0.04), (1.1, -0.03), (1.0, 0.05)])
def test_with_the_proposed_pulse_map_the_axle_stands_as_requested(axle, gain, trim):
    found = proposal()
    assert found.consider(state(row(axle, gain, trim)), DATE)
    k, linkage = ("front", "rear").index(axle), TRUCK.chassis().linkage
    old, new = (
        getattr(config.devices.steering.driver, axle)
        for config in (TRUCK, with_values(TRUCK, [found.result], "proposed"))
    )

    def stands(wanted):
        """The axle, asked by the proposed map; its true one is the old one with the gain and trim."""
        asked = [0.0, 0.0]
        asked[k] = wanted
        pulse = new.centre_us + new.direction * new.scale_us_per_deg * math.degrees(linkage.servos(*asked)[k])
        servo = [0.0, 0.0]
        servo[k] = math.radians((pulse - old.centre_us) * old.direction / old.scale_us_per_deg)
        return gain * linkage.angles(*servo)[k] + trim

    for wanted in np.linspace(-0.2, 0.2, 9):
        assert stands(wanted) == pytest.approx(wanted, abs=0.004)


def test_an_interval_holds_what_the_covariance_says():
    found = proposal()
    found.consider(state(row(gain=1.0, trim=0.0)), DATE)
    scale, centre = (found.result.estimate(f"front_{name}") for name in ("scale", "centre"))
    assert (scale.high - scale.low) / 2 == pytest.approx(1.96 * 0.01 * scale.value, rel=0.01)
    assert 5.0 < (centre.high - centre.low) / 2 < 8.0  # 0.34 degrees of the axle
    assert scale.samples == 40


def test_it_is_kept_over_a_restart_and_void_on_another_calibration(tmp_path):
    file = tmp_path / "state" / "proposed.json"
    first = proposal(file)
    first.consider(state(row()), DATE)
    first.save()
    again, other = proposal(file), proposal(file, base="0002.json")
    assert (again.load(), other.load()) == ("", "")
    assert again.result == first.result
    assert other.result is None
    again.close()
    again.save()
    assert not file.exists()


def test_the_same_finding_is_not_proposed_twice_and_slip_never():
    found = proposal()
    assert not found.consider(state(row(servo=False)), DATE)
    assert found.consider(state(row()), DATE)
    assert not found.consider(state(row(gain=0.905)), DATE)
    assert found.consider(state(row(gain=0.95)), DATE)
    assert found.consider(state(row(gain=0.95), row("rear")), DATE)


def test_once_the_steering_is_calibrated_nothing_is_proposed_until_the_next_start():
    found = proposal()
    found.consider(state(row()), DATE)
    found.close()
    assert found.result is None
    assert not found.consider(state(row()), DATE)


def test_a_robot_without_that_steering_proposes_nothing():
    blind = TRUCK.model_copy(update={"devices": TRUCK.devices.model_copy(update={"compass": None})})
    assert not proposal(config=blind).consider(state(row()), DATE)


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b'{"base": 1}', b"\xff\xfe", b"[" * 5000])
def test_a_damaged_file_is_reported_and_put_aside(content, tmp_path):
    file = tmp_path / "proposed.json"
    file.write_bytes(content)
    found = proposal(file)
    assert str(file) in found.load()
    assert found.result is None
    assert "damaged" in found.put_aside()
    assert not file.exists()


def test_what_is_accepted_keeps_the_other_results_of_the_steering(tmp_path):
    store = CalibrationStore(tmp_path, TRUCK.robot)
    found = proposal()
    found.consider(state(row("rear")), DATE)
    store.save(found.result, 10**9 * SECOND)
    front = proposal()
    front.consider(state(row("front")), DATE)
    store.save(front.result, 10**9 * SECOND)
    names = {estimate.name for estimate in store.current().results["steering"].estimates}
    assert names == {"front_centre", "front_scale", "rear_centre", "rear_scale"}
