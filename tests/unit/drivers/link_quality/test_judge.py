"""Levels with hysteresis, means with their time constant."""

import pytest

from monstertruck_drivers.link_quality.config import LinkQualityConfig
from monstertruck_drivers.link_quality.driver import LinkJudge
from monstertruck_drivers.link_quality.interfaces import Sample, Signal
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.health import LinkLevel, LinkMedium

L = LinkLevel


def sample(level: float | None, name: str = "wlan0", **changes: object) -> Sample:
    values = {"name": name, "medium": LinkMedium.WIFI, "connected": True, "signal": Signal(level, None)}
    rest = {"bit_rate": None, "received": 0, "sent": 0, "errors": 0}
    return Sample(**(values | rest | changes))  # type: ignore[arg-type]


def levels(*signals: float) -> list[LinkLevel]:
    judge = LinkJudge(LinkQualityConfig(smoothing=0.0))
    return [judge.update(t * SECOND, sample(signal)) for t, signal in enumerate(signals)]


def test_each_level_begins_at_its_limit():
    for signal, level in (
        (-50, L.EXCELLENT),
        (-50.1, L.GOOD),
        (-67, L.GOOD),
        (-75, L.FAIR),
        (-85, L.POOR),
        (-86, L.UNUSABLE),
    ):
        assert levels(signal) == [level]


def test_worse_at_once_better_only_with_three_decibels():
    assert levels(-66, -68, -66, -64.1, -64) == [L.GOOD, L.FAIR, L.FAIR, L.FAIR, L.GOOD]
    assert levels(-90, -83, -82, -40) == [L.UNUSABLE, L.UNUSABLE, L.POOR, L.EXCELLENT]


def test_a_signal_around_a_limit_does_not_flicker():
    assert set(levels(-66, *[-67.5, -66.5] * 20)[1:]) == {L.FAIR}


def test_the_mean_has_its_time_constant():
    judge = LinkJudge(LinkQualityConfig(smoothing=4.0))
    judge.update(0, sample(-50))
    for t in range(1, 5):
        judge.update(t * SECOND, sample(-60))
    assert judge.signal == pytest.approx(-60 + 10 * 0.368, abs=0.01)


def test_a_new_connection_or_interface_starts_anew():
    judge = LinkJudge(LinkQualityConfig())
    judge.update(0, sample(-84))
    assert judge.update(SECOND, sample(None, connected=False)) is L.DOWN
    assert judge.signal is None
    assert judge.update(2 * SECOND, sample(-50)) is L.EXCELLENT
    assert judge.update(3 * SECOND, sample(-84, name="wlan1")) is L.POOR


def test_no_interface_a_cable_and_a_kernel_that_does_not_tell():
    judge = LinkJudge(LinkQualityConfig())
    assert judge.update(0, None) is L.DOWN
    assert judge.update(1, sample(None, medium=LinkMedium.ETHERNET, signal=None)) is L.EXCELLENT
    assert judge.update(2, sample(None)) is L.UNKNOWN
    assert judge.update(3, sample(None, signal=None)) is L.UNKNOWN


def test_limits_must_be_in_order():
    with pytest.raises(ValueError, match=r"fair -60\.0 < good -67\.0"):
        LinkQualityConfig(fair=-60.0)
