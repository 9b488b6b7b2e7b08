import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.zones import Zone, Zones
from monstertruckd.tools.logs.report.collect import RunSummary
from monstertruckd.tools.logs.report.drawing import clock_text, line, scene, time_ticks, value_axis
from monstertruckd.tools.logs.report.signals import Trace
from monstertruckd.tools.logs.report.states import StateSpan, StateTrack, Tone, merged_spans


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=3000), st.integers(4, 50))
def test_any_number_of_samples_fits_and_keeps_its_extremes(values, limit):
    trace = Trace(limit)
    for i, value in enumerate(values):
        trace.add(i * SECOND // 50, value)
    assert len(trace.buckets) <= limit
    assert len(trace.buckets) >= min(len(values), limit // 4)
    assert (trace.low, trace.high, trace.count) == (min(values), max(values), len(values))
    times = [(bucket.first, bucket.last) for bucket in trace.buckets]
    assert times == sorted(times)
    assert (times[0][0], times[-1][1]) == (0, (len(values) - 1) * SECOND // 50)


def test_spike_of_one_sample_survives_an_hour():
    trace = Trace(500)
    for i in range(36_000):
        trace.add(i * SECOND // 10, 7.0 if i == 20_000 else 0.0)
    (bucket,) = (bucket for bucket in trace.buckets if bucket.high == 7.0)
    assert bucket.first <= 2_000 * SECOND <= bucket.last


def test_lines_break_where_samples_are_missing():
    trace = Trace()
    for second in (*range(10), *range(30, 40)):
        trace.add(second * SECOND, float(second % 3))
    assert [len(piece) for piece in trace.pieces()] == [10, 10]
    axis = value_axis([0.0, 2.0], 1.0, zero=True)
    assert line(trace, axis, 0, 40 * SECOND).count("M") == 2
    assert Trace().pieces() == []


def test_level_stretches_cost_two_points():
    trace = Trace()
    for i in range(500):
        trace.add(i * SECOND, 1.0)
    path = line(trace, value_axis([1.0], 1.0, zero=True), 0, 499 * SECOND)
    assert path == "M0 0L1000 0"


@given(st.lists(st.floats(-1e5, 1e5), min_size=1), st.floats(0.01, 100), st.booleans())
def test_axis_covers_every_value_with_round_ticks(values, span, zero):
    axis = value_axis(values, span, zero=zero)
    slack = 1e-6 * (axis.high - axis.low)
    assert axis.low - slack <= min(values)
    assert max(values) <= axis.high + slack
    assert axis.high - axis.low >= span * (1 - 1e-6)
    assert not zero or axis.low <= 0 <= axis.high
    assert 2 <= len(axis.ticks) <= 8
    labels = [axis.label(tick) for tick in axis.ticks]
    assert len(set(labels)) == len(labels)
    assert all(math.isclose(axis.share(t), i / (len(axis.ticks) - 1), abs_tol=1e-6) for i, t in enumerate(axis.ticks))


def test_instants_are_round():
    assert time_ticks(82.3) == [0, 10, 20, 30, 40, 50, 60, 70, 80]
    assert time_ticks(3600)[1] == 600
    assert clock_text(3725.25, 1) == "1:02:05.2"
    assert (clock_text(59.999), clock_text(59.996, 2)) == ("1:00", "1:00.00")


def test_track_merges_equal_states_and_short_ones_keep_the_worst():
    track = StateTrack("gate")
    for time, text, tone in ((0, "a", Tone.GOOD), (5, "a", Tone.GOOD), (100, "b", Tone.BAD), (101, "a", Tone.GOOD)):
        track.set(time, text, tone)
    track.set(102, "c", Tone.WARNING)
    track.close(200)
    assert [(span.start, span.end, span.text) for span in track.spans] == [
        (0, 100, "a"),
        (100, 101, "b"),
        (101, 102, "a"),
        (102, 200, "c"),
    ]
    assert track.seconds("a") == pytest.approx(101 / SECOND)
    assert track.worst is Tone.BAD
    assert [span.text for span in merged_spans(track.spans, 10)] == ["a", "b", "c"]
    assert merged_spans([StateSpan(0, 9, "", Tone.NONE)], 1) == []


def test_middle_of_intervals():
    trace = Trace()
    trace.add(4, 1.0)
    trace.add(8, 3.0)
    times, values = trace.middle()
    assert times.dtype == np.int64
    assert (times.tolist(), values.tolist()) == ([4, 8], [1.0, 3.0])


def test_the_map_shows_zones_and_has_room_for_them():
    run = RunSummary(Path("run.mcap"), 0)
    corners = ((5.0, 5.0), (7.0, 5.0), (6.0, 8.0))
    zones = (Zone(name="stairs", kind="keepout", corners=corners), Zone(name="hall", kind="speed", corners=corners))
    run.zones = Zones(stamp=0, received=0, seq=0, zones=zones)
    assert scene(run) == ""
    run.way.take(0, 0.0, 0.0)
    picture = scene(run)
    assert 'class="keepout" d="M5.000 -5.000L7.000 -5.000L6.000 -8.000Z"><title>stairs</title>' in picture
    assert 'viewBox="-0.350 -8.350 7.700 8.700"' in picture
    assert "keepout zone" in picture
    assert "speed zone" in picture
    run.zones = None
    assert "zone" not in scene(run)
