"""The newest messages in memory: by time, by size, freed in blocks."""

import tracemalloc
from itertools import pairwise

import pytest

from monstertruck_runtime import wire
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas import topics as t
from monstertruck_schemas.sensor import CompressedImage
from monstertruckd.recorder.log_file import LogEntry
from monstertruckd.recorder.ring import SHARE, Retention, Ring

SPAN = Retention(everything=65.0, journal=300.0, pictures=10.0, picture_period=0.5)


def picture(now, size=1000):
    image = CompressedImage(stamp=now, received=now, seq=0, data=b"\xff" * size, format="jpeg", sequence=0)
    return LogEntry(t.CAMERA, now, now, 0, wire.encode(t.CAMERA, image))


def command(now, size=100):
    return LogEntry(t.CMD_DRIVE, now, now, 0, bytes(size))


def test_old_pictures_are_thinned_out():
    ring = Ring(SPAN, 1 << 30)
    for number in range(15 * 100):
        ring.add(picture(number * SECOND // 15))
    times = [entry.log_time / SECOND for entry in ring.snapshot()]
    newest = times[-1]
    assert sum(time > newest - 10 for time in times) == pytest.approx(150, abs=1)
    older = [time for time in times if time < newest - 10.01]
    assert len(older) == pytest.approx(55 / 0.533, abs=3)
    assert min(later - earlier for earlier, later in pairwise(older)) >= 0.5
    assert times[0] >= newest - 65
    assert ring.lost == 0


def test_memory_is_bounded_and_pictures_go_first():
    limit = 200_000
    ring = Ring(SPAN, limit)
    for number in range(600):
        now = number * SECOND // 15
        ring.add(picture(now))
        ring.add(command(now, 400))
        assert ring.size <= limit
    entries = list(ring.snapshot())
    assert ring.size > 0.9 * limit
    assert sum(len(entry.payload) for entry in entries) > 0.6 * limit
    assert sum(entry.topic is t.CMD_DRIVE for entry in entries) < 600
    assert sum(entry.topic is t.CAMERA for entry in entries) < limit / SHARE / 1000, "no more than the newest block"
    assert ring.lost == 1200 - len(entries)
    ring.add(command(40 * SECOND, 10 * limit))
    assert len(ring.snapshot()) == 2, "the newest of each sort is kept whatever its size"
    assert max(len(entry.payload) for entry in ring.snapshot()) == 10 * limit


def test_a_flood_of_log_records_displaces_no_measurement():
    limit = 1_000_000
    ring = Ring(SPAN, limit)
    for number in range(1500):
        ring.add(command(number * SECOND // 50, 300))
    for number in range(20_000):
        now = 30 * SECOND + number * SECOND // 1000
        ring.add(LogEntry(t.LOG, now, now, 0, bytes(200)))
        assert ring.size <= limit
    entries = list(ring.snapshot())
    assert sum(entry.topic is t.CMD_DRIVE for entry in entries) == 1500
    assert entries[-1].log_time == 30 * SECOND + 19_999 * SECOND // 1000, "the newest records are there"
    assert ring.lost == 21_500 - len(entries)


def test_pictures_that_are_thinned_out_keep_to_the_limit_too():
    limit = 1_000_000
    ring = Ring(SPAN, limit)
    for number in range(600):
        ring.add(picture(number * SECOND // 15))
        assert ring.size <= limit
    ring.snapshot()
    assert ring.size <= limit


def test_an_empty_ring_gives_nothing():
    snapshot = Ring(SPAN, 1000).snapshot()
    assert (len(snapshot), list(snapshot)) == (0, [])


def test_a_snapshot_copies_nothing_and_stays_as_it_was():
    ring = Ring(SPAN, 1 << 30)
    for number in range(6000):
        ring.add(command(number * SECOND // 100))
    snapshot = ring.snapshot()
    assert len(snapshot) == 6000
    assert sum(len(view.blocks) for view in snapshot._views) < 60, "references to blocks, not to entries"
    iterator = iter(snapshot)
    first = [next(iterator) for _ in range(10)]
    for number in range(6000, 18_000):
        ring.add(command(number * SECOND // 100))
    times = [entry.log_time for entry in (*first, *iterator)]
    assert times == [number * SECOND // 100 for number in range(6000)]
    assert len(ring.snapshot()) == 6501


def test_what_is_no_longer_kept_is_freed():
    ring = Ring(SPAN, 4_000_000)
    tracemalloc.start()
    for number in range(400):
        ring.add(picture(number * SECOND // 15, 50_000))
    used, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert ring.lost
    assert used < 4_400_000
