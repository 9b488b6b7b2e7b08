"""Values that repeat to the digit: accused only where their noise does not allow it."""

import math

import numpy as np
import pytest

from monstertruck_estimation.consistency.repeats import RepeatDetector, WholeRepeats, scan_content
from tests.unit.gate.rig import scan

LEAST_ROW = 40


def shown(values, digit):
    return (np.round(np.asarray(values) / digit) * digit).tolist()


def first_accused(values, still=True):
    repeats = RepeatDetector()
    for k, value in enumerate(values):
        repeats.observe(value, still=still)
        if repeats.frozen:
            return k
    return None


@pytest.mark.parametrize("noise", [1.0, 2.0, 5.0])
def test_a_frozen_value_with_noise_is_accused_soon(noise):
    rng = np.random.default_rng(4)
    values = shown(rng.normal(20.0, noise, 200), 1.0)
    accused = first_accused([*values, *[values[-1]] * 300])
    assert accused is not None
    assert 200 + LEAST_ROW - 3 <= accused <= 200 + 80


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.3, 0.5, 0.7, 1.0, 3.0])
def test_a_value_that_lives_is_never_accused(noise):
    rng = np.random.default_rng(5)
    for middle in (0.0, 0.25, 0.5):
        assert first_accused(shown(rng.normal(middle, noise, 50_000), 1.0)) is None


def test_a_voltage_that_settles_into_one_digit_is_not_accused():
    """It flickered between two digits before: noise of less than one."""
    rng = np.random.default_rng(6)
    values = [*rng.normal(0.5, 0.3, 2000), *rng.normal(0.0, 0.1, 20_000)]
    assert first_accused(shown(values, 1.0)) is None


def test_noise_is_learned_while_the_robot_stands_alone():
    rng = np.random.default_rng(7)
    values = shown(rng.normal(0.0, 3.0, 200), 1.0)
    assert first_accused([*values, *[0.0] * 500], still=False) is None


def test_a_repeated_scan_is_accused_where_noise_changed_each():
    scans, repeats = WholeRepeats(), []
    for k in range(40):
        scans.observe(bytes([min(k, 20)]), moved=0.0)
        repeats.append(scans.frozen)
    assert repeats.index(True) == 22
    scans.observe(b"other", moved=0.0)
    assert not scans.frozen


def test_without_noise_a_repeated_scan_is_accused_only_once_the_robot_moves():
    scans = WholeRepeats()
    for _ in range(1000):
        scans.observe(b"same", moved=0.0)
    assert not scans.frozen
    for _ in range(6):
        scans.observe(b"same", moved=0.03)
    assert scans.frozen


def lidar_scan(ranges):
    ranges = np.asarray(ranges, dtype=float)
    return scan(0).model_copy(update={"ranges": ranges, "codes": np.full(len(ranges), 255, np.uint8)})


def test_a_lidar_that_repeats_one_packet_is_accused_however_its_revolutions_are_cut():
    rng, scans = np.random.default_rng(8), WholeRepeats()
    for _ in range(20):
        scans.observe(scan_content(lidar_scan(shown(rng.normal(2.0, 0.01, 450), 0.001))), moved=0.0)
    assert not scans.frozen
    packet = shown(rng.normal(2.0, 0.01, 12), 0.001)
    for cut, beams in ((0, 450), (6, 449), (3, 451), (9, 450)):
        scans.observe(scan_content(lidar_scan(np.resize(np.roll(packet, cut), beams))), moved=0.0)
    assert scans.frozen


@pytest.mark.parametrize("missing", [0, 4, 9])
def test_a_packet_without_some_returns_is_accused_though_resampled_beams_are_lost(missing):
    rng, scans = np.random.default_rng(10), WholeRepeats()
    packet = shown(rng.normal(2.0, 0.01, 12), 0.001)
    for cut in (0, 6, 3, 9):
        points = np.delete((np.arange(452) + cut) % 12, rng.choice(452, 3))
        codes = np.where(points < missing, 0, 255).astype(np.uint8)
        ranges = np.where(points < missing, math.inf, np.take(packet, points))
        scans.observe(scan_content(lidar_scan(ranges).model_copy(update={"codes": codes})), moved=0.05)
    assert scans.frozen


@pytest.mark.parametrize(
    ("beams", "digit", "noise", "nearest", "farthest"),
    [
        (1440, 0.01, 0.1, 0.9, 1.05),
        (1440, 0.01, 0.1, 0.9, 1.1),
        (450, 0.001, 0.003, 0.9, 1.1),
        (24, 0.001, 0.001, 0.9, 1.1),
    ],
)
def test_a_lidar_of_coarse_digits_near_walls_is_not_accused(beams, digit, noise, nearest, farthest):
    rng, scans = np.random.default_rng(9), WholeRepeats()
    for _ in range(600):
        ranges = rng.normal(1.0, noise, beams).clip(nearest, farthest)
        scans.observe(scan_content(lidar_scan(shown(ranges, digit))), moved=0.05)
        assert not scans.frozen


def test_a_scan_with_few_ranges_has_no_content():
    codes = np.array([0] * 11 + [255] * 19, np.uint8)
    assert scan_content(lidar_scan(np.linspace(1.0, 2.0, 30)).model_copy(update={"codes": codes})) is None
