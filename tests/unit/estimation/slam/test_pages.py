"""Remembered points of many scans."""

import numpy as np

from monstertruck_estimation.slam.grid import PAGE_POINTS, Pages


def test_scans_are_remembered_as_they_came():
    rng = np.random.default_rng(1)
    scans = [rng.integers(-32000, 32000, (count, 2)).astype(np.int16) for count in rng.integers(1, 700, 900)]
    pages = Pages()
    for scan in scans:
        pages.append(scan)
    assert len(pages) == len(scans)
    assert all(np.array_equal(pages[k], scan) for k, scan in enumerate(scans))


def test_what_is_forgotten_leaves_no_hole():
    rng = np.random.default_rng(2)
    pages, expected, most = Pages(), [], 0
    for _ in range(12):
        for count in rng.integers(1, 5000, 120):
            scan = rng.integers(-32000, 32000, (count, 2)).astype(np.int16)
            pages.append(scan)
            expected.append(scan)
        kept = [k for k in range(len(expected)) if k % 2 == 0]
        pages.keep(kept)
        expected = [expected[k] for k in kept]
        assert all(np.array_equal(pages[k], scan) for k, scan in enumerate(expected))
        most = max(most, len(pages._pages))
    assert most * PAGE_POINTS < 1.3 * 240 * 5000 / 2 + 2 * PAGE_POINTS


def test_a_scan_may_be_larger_than_a_page():
    pages = Pages()
    scans = [np.full((count, 2), k, np.int16) for k, count in enumerate((10, PAGE_POINTS + 5, 3, 2 * PAGE_POINTS, 7))]
    for scan in scans:
        pages.append(scan)
    pages.keep([1, 3, 4])
    assert [len(pages[k]) for k in range(3)] == [PAGE_POINTS + 5, 2 * PAGE_POINTS, 7]
    assert [int(pages[k][0, 0]) for k in range(3)] == [1, 3, 4]
    assert all((pages[k] == pages[k][0, 0]).all() for k in range(3))
