"""Falsified signals of emulated devices."""

from collections.abc import Callable

import numpy as np
import pytest

from monstertruck_drivers.signals import FAULTS, SignalKind, Signals
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import InputError

KINDS = {
    "speed": SignalKind.NUMBER,
    "current": SignalKind.NUMBER,
    "range": SignalKind.ARRAY,
    "image": SignalKind.THING,
    "target": SignalKind.ORDER,
    "stop": SignalKind.SWITCH,
}


class Time:
    """A clock that is set."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def __call__(self) -> int:
        return round(self.seconds * SECOND)


@pytest.fixture
def time() -> Time:
    return Time()


@pytest.fixture
def signals(time: Time) -> Signals:
    return Signals(time, KINDS, np.random.default_rng(1))


def series(signals: Signals, name: str, *values: float) -> list[float]:
    return [signals.report(name, value) for value in values]


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        ("scaled 0.5", [1, 2, 4]),
        ("offset -3", [-1, 1, 5]),
        ("negated", [-2, -4, -8]),
        ("quantised 5", [0, 5, 10]),
        ("frozen", [10, 10, 10]),
        ("repeated 2", [2, 2, 8]),
        ("swapped", [77, 77, 77]),
    ],
)
def test_a_falsified_number_stays_a_whole_number(signals: Signals, fault: str, expected: list[int]) -> None:
    signals.report("current", 77)
    signals.report("speed", 10)
    signals.inject("speed", *fault.split())
    shown = series(signals, "speed", 2, 4, 8)
    assert shown == expected
    assert all(isinstance(value, int) for value in shown)
    signals.inject("speed", "off")
    assert series(signals, "speed", 2, 4, 8) == [2, 4, 8]


def test_faults_of_one_signal_add_up_and_leave_the_others_alone(signals: Signals) -> None:
    signals.inject("speed", "scaled", "2")
    signals.inject("speed", "offset", "1")
    assert series(signals, "speed", 1.5) == [4.0]
    assert series(signals, "current", 1.5) == [1.5]


def test_a_late_value_is_the_one_of_so_many_seconds_ago(signals: Signals, time: Time) -> None:
    signals.report("speed", 7)
    signals.inject("speed", "delayed", "0.25")
    shown = []
    for tick in range(6):
        time.seconds = 0.1 * tick
        shown.append(signals.report("speed", tick))
    assert shown == [7, 7, 7, 0, 1, 2]


def test_a_dropped_share_of_values_leaves_the_one_before(signals: Signals) -> None:
    signals.inject("speed", "dropped", "0.5")
    shown = series(signals, "speed", *range(1000))
    kept = sum(value == true for value, true in zip(shown, range(1000), strict=True))
    assert 400 < kept < 600
    assert shown == sorted(shown)


def test_arrays_are_falsified_as_a_whole(signals: Signals) -> None:
    scan = np.array([10, 20, 30, 40], dtype=np.int32)
    for fault, expected in {
        "scaled 2": [20, 40, 60, 80],
        "shifted 1": [40, 10, 20, 30],
        "mirrored": [40, 30, 20, 10],
        "quantised 15": [15, 15, 30, 45],
    }.items():
        signals.inject("range", *fault.split())
        shown = signals.report("range", scan)
        assert shown.dtype == np.int32, fault
        assert shown.tolist() == expected, fault
        signals.inject("range", "off")
    assert scan.tolist() == [10, 20, 30, 40]
    assert signals.extent("range") == 40


def test_a_frozen_array_with_noise_differs_each_time(signals: Signals) -> None:
    signals.report("range", np.full(50, 1000))
    signals.inject("range", "frozen")
    signals.inject("range", "noisy", "5")
    one, other = (signals.report("range", np.zeros(50, dtype=np.int64)) for _ in range(2))
    assert (one != other).any()
    assert abs(one.mean() - 1000) < 5


def test_orders_are_ignored_and_falsified(signals: Signals) -> None:
    given: list[float] = []

    def order(*values: float) -> list[float]:
        given.clear()
        for value in values:
            signals.order("target", value, given.append)
        return list(given)

    assert order(3, 2, 1) == [3, 2, 1]
    signals.inject("target", "ignored")
    assert order(3, 2, 1) == []
    signals.inject("target", "off")
    signals.inject("target", "negated")
    assert order(3, -2) == [-3, 2]
    signals.inject("target", "off")
    signals.order("target", 2, given.append)
    signals.inject("target", "growing")
    assert order(1, 0, -1, 3, 2) == [3]
    signals.inject("stop", "ignored")
    assert signals.order("stop", None, lambda _: "stopped") is None
    signals.inject("stop", "off")
    assert signals.order("stop", None, lambda _: "stopped") == "stopped"


def test_late_orders_keep_their_sequence() -> None:
    async def main(clock: VirtualClock) -> None:
        given: list[tuple[float, int]] = []
        signals = Signals(clock.now, KINDS, np.random.default_rng(1))
        begin = clock.now()

        def obey(value: int) -> None:
            given.append((round((clock.now() - begin) / SECOND, 3), value))

        signals.inject("target", "late", "0.3")
        signals.order("target", 1, obey)
        await clock.sleep(0.1)
        signals.inject("target", "off")
        signals.order("target", 2, obey)
        assert given == []
        await clock.sleep(0.5)
        signals.order("target", 3, obey)
        assert given == [(0.3, 1), (0.3, 2), (0.6, 3)]

    run_virtual(main)


def test_every_fault_named_can_be_injected_into_every_signal_it_is_named_for(signals: Signals) -> None:
    offered = list(signals.faults())
    assert {name for name, _ in offered} == set(KINDS)
    assert {fault for _, fault in offered} == set(FAULTS) - {"swapped"} | {"swapped"}
    assert ("target", "swapped") not in offered, "an order without a neighbour"
    for name, fault in offered:
        signals.inject(name, fault, *(["0.5"] if FAULTS[fault].argument else []))


@pytest.mark.parametrize(
    "words",
    [["speeed", "frozen"], ["speed", "ignored"], ["speed", "scaled"], ["speed", "scaled", "x"], ["stop", "negated"]],
)
def test_what_does_not_fit_is_refused(signals: Signals, words: list[str]) -> None:
    with pytest.raises(InputError, match="signal"):
        signals.inject(*words)


def test_one_seed_gives_one_noise(time: Time) -> None:
    def noise(make: Callable[[], np.random.Generator]) -> list[float]:
        signals = Signals(time, KINDS, make())
        signals.inject("speed", "noisy", "1")
        return series(signals, "speed", 0.0, 0.0)

    assert noise(lambda: np.random.default_rng(1)) == noise(lambda: np.random.default_rng(1))
    assert noise(lambda: np.random.default_rng(1)) != noise(lambda: np.random.default_rng(2))


def test_codes_in_an_array_are_spared_by_faults_that_calculate():
    signals = Signals(lambda: 0, {"range": SignalKind.ARRAY}, np.random.default_rng(1), codes={"range": 20})
    signals.inject("range", "scaled", "2")
    assert signals.report("range", np.array((0, 19, 20, 500))).tolist() == [0, 19, 40, 1000]
    signals.inject("range", "off")
    signals.inject("range", "mirrored")
    assert signals.report("range", np.array((0, 19, 20, 500))).tolist() == [500, 20, 19, 0]


def test_a_kind_of_signal_that_does_not_exist_is_named():
    with pytest.raises(InputError, match=r"signal range: expected SignalKind\.NUMBER or .*, found 'nummer'"):
        Signals(lambda: 0, {"range": "nummer"}, np.random.default_rng(0))
    with pytest.raises(InputError, match="signal 'rang': expected one of range"):
        Signals(lambda: 0, {"range": SignalKind.NUMBER}, np.random.default_rng(0)).report("rang", 1)
