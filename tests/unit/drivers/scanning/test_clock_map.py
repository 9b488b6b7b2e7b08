"""Stamps follow the sensor's clock through drift, jitter, wraps and restarts."""

import numpy as np
import pytest

from monstertruck_drivers.scanning.clock_map import Anchor, ClockMap

MS = 1_000_000
SECOND = 1000 * MS
LATENCY = 73 * MS
WRAP = 1 << 24


def simulate(
    *,
    seconds: int,
    drift_ppm: float,
    jitter_ms: float,
    start: int = WRAP - 60_000,
    seed: int = 1,
    exponential: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Stamps and true times of a stream at 10 Hz whose counter starts at ``start`` ms."""
    rng = np.random.default_rng(1)
    rate = 1 + drift_ppm * 1e-6
    origin = 12_345_678_901

    def counter(time: int) -> int:
        return int((time - origin) * rate // MS + start) % WRAP

    anchor = Anchor(counter(origin + SECOND), origin + SECOND + 200_000, 800_000)
    mapping = ClockMap(0, anchor)
    truth = origin + 2 * SECOND + (np.arange(seconds * 10) * 100 * MS / rate).astype(np.int64)
    late = rng.exponential(jitter_ms / 4, len(truth)) if exponential else rng.uniform(0, jitter_ms, len(truth))
    arrivals = np.maximum.accumulate(truth + LATENCY + (late * MS).astype(np.int64))
    stamps = [mapping.stamp(counter(int(t)), int(a)) for t, a in zip(truth, arrivals, strict=True)]
    assert mapping.restarts == 0
    return np.array(stamps), truth


@pytest.mark.parametrize("exponential", [False, True])
@pytest.mark.parametrize("jitter_ms", [0.0, 4.0, 20.0])
@pytest.mark.parametrize("drift_ppm", [-200.0, -50.0, 0.0, 200.0])
def test_stamps_stay_true(drift_ppm: float, jitter_ms: float, exponential: bool):
    """Ten minutes with a wrap after one: 200 ppm would be 120 ms by then."""
    stamps, truth = simulate(seconds=600, drift_ppm=drift_ppm, jitter_ms=jitter_ms, exponential=exponential)
    assert np.abs(stamps - truth).max() < 5 * MS
    assert np.all(np.diff(stamps) > 0)


def test_without_a_comparison_the_nominal_latency_serves():
    mapping = ClockMap(70 * MS)
    assert mapping.stamp(500, SECOND) == SECOND - 70 * MS
    assert mapping.stamp(600, SECOND + 110 * MS) == pytest.approx(SECOND + 30 * MS, abs=MS)


def test_a_late_arrival_does_not_move_the_stamp():
    mapping = ClockMap(0, Anchor(0, 0))
    for scan in range(100):
        mapping.stamp(scan * 100, scan * 100 * MS + LATENCY)
    late = mapping.stamp(10_000, 10_000 * MS + LATENCY + 400 * MS)
    assert late == pytest.approx(10_000 * MS, abs=MS)


def test_restart_is_counted_and_mapped_by_the_latency_found():
    mapping = ClockMap(0, Anchor(3_000_000, 0))
    for scan in range(100):
        mapping.stamp(3_000_000 + scan * 100, scan * 100 * MS + LATENCY)
    for scan in range(100, 200):
        stamp = mapping.stamp((scan - 100) * 100, scan * 100 * MS + LATENCY)
        assert stamp == pytest.approx(scan * 100 * MS, abs=MS)
    assert mapping.restarts == 1


def test_restart_before_the_first_scan_uses_the_nominal_latency():
    mapping = ClockMap(LATENCY, Anchor(3_000_000, 0))
    assert mapping.stamp(5, SECOND + LATENCY) == SECOND
    assert mapping.restarts == 1


def test_a_wrap_is_no_restart():
    mapping = ClockMap(0, Anchor(WRAP - 50, 0))
    assert mapping.stamp(50, 100 * MS + LATENCY) == 100 * MS
    assert mapping.restarts == 0


def test_the_stamp_never_steps_backwards():
    """The estimate falls by 300 ms at once when the first prompt sample comes after the comparison expired."""
    mapping = ClockMap(400 * MS)
    stamps = [mapping.stamp(1000, 10 * SECOND), mapping.stamp(1010, 9 * SECOND + 720 * MS)]
    assert stamps[1] == stamps[0] + 1


def two_clocks(
    *,
    seconds: int,
    drift_ppm: float = 0.0,
    slew: float = 0.0,
    jump_ms: float = 0.0,
    jitter_ms: float = 10.0,
    at: float = 40.0,
    lasts: float = 5.0,
    nominal: int = 0,
) -> tuple[np.ndarray, ClockMap]:
    """Errors of the stamps, ms, of a stream whose host's clock is slewed by a share ``slew`` from ``at`` s on.

    From 60 s on scans arrive ``jump_ms`` later. ``lasts``: s of the slew. ``nominal``: latency the map is given, ns.
    """
    rng = np.random.default_rng(2)
    rate, origin = 1 + drift_ppm * 1e-6, 12_345_678_901
    truth = origin + 2 * SECOND + (np.arange(seconds * 10) * 100 * MS / rate).astype(np.int64)

    def host(time: np.ndarray) -> np.ndarray:
        return (time + slew * np.clip(time - origin - at * SECOND, 0, lasts * SECOND)).astype(np.int64)

    counters = ((truth - origin) * rate // MS + 3_000_000).astype(np.int64) % WRAP
    late = rng.uniform(0, jitter_ms, len(truth)) + jump_ms * (truth - origin > 60 * SECOND)
    arrivals = np.maximum.accumulate(host(truth + LATENCY + (late * MS).astype(np.int64)))
    mapping = ClockMap(nominal, Anchor(3_000_000, int(host(np.array([origin]))[0])))
    stamps = np.array([mapping.stamp(int(c), int(a)) for c, a in zip(counters, arrivals, strict=True)])
    assert np.all(np.diff(stamps) > 0)
    return (stamps - host(truth)) / MS, mapping


@pytest.mark.parametrize("drift_ppm", [-10_000.0, -300.0, 300.0, 10_000.0])
def test_the_drift_is_estimated(drift_ppm: float):
    """300 ppm were a second late within the hour; a hundredth is a second in 100 s."""
    errors, mapping = two_clocks(seconds=600, drift_ppm=drift_ppm)
    assert np.abs(errors).max() < 80
    assert np.abs(errors[100:]).max() < 5
    assert mapping.drift == pytest.approx(-drift_ppm * 1e-6, rel=0.05, abs=3e-5)
    assert mapping.late == 0


@pytest.mark.parametrize("slew", [-0.1, 0.1])
def test_slews_are_followed(slew: float):
    """The kernel slews by a tenth at most: half a second within five."""
    errors, mapping = two_clocks(seconds=120, slew=slew)
    assert np.abs(errors).max() < 110
    assert np.abs(errors[-300:]).max() < 5
    assert mapping.late == 0


@pytest.mark.parametrize("at", [8.0, 11.5, 16.0, 18.0])
@pytest.mark.parametrize("slew", [-0.1, -0.037, -0.01, 0.01, 0.037, 0.1])
def test_slews_while_the_latency_is_being_found_are_followed(slew: float, at: float):
    """As after the start of the computer, when its clock is set."""
    errors, _ = two_clocks(seconds=60, slew=slew, at=at)
    assert np.abs(errors[300:]).max() < 50


@pytest.mark.parametrize("lasts", [3.0, 5.0, 60.0])
@pytest.mark.parametrize("at", [2.5, 3.0, 4.0, 6.0, 7.5])
@pytest.mark.parametrize("slew", [-0.1, -0.037, -0.01, 0.01, 0.037, 0.1])
def test_a_slew_in_the_first_seconds_of_scans_is_followed(slew: float, at: float, lasts: float):
    """They begin 2 s after the comparison; before the drift is known, those of a fast sensor seem to come too soon."""
    errors, _ = two_clocks(seconds=90, slew=slew, at=at, lasts=lasts, nominal=LATENCY - 2 * MS)
    assert np.abs(errors).max() < 115
    assert np.abs(errors[-100:]).max() < 40


def test_scans_that_become_late_are_late():
    """No clock jumps: their stamps stay true, and the map says so."""
    errors, mapping = two_clocks(seconds=70, jump_ms=400.0)
    assert np.abs(errors).max() < 5
    assert mapping.late == pytest.approx(400 * MS, abs=10 * MS)
