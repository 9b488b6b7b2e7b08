"""Examples of other programs' files that ``benchmarks/files.py`` compares."""

from benchmarks.files import judged, lenses, paths, waypoints


def test_every_example_has_its_producers_values_and_damaged_ones_are_refused_by_name():
    rows = {name: judged(examples) for name, examples in (paths() | waypoints() | lenses()).items()}
    assert len(rows) == 7
    assert {name: (row["which"], row["unnamed"]) for name, row in rows.items()} == {name: ([], 0) for name in rows}
