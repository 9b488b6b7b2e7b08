"""The page of the thesis's experiments."""

import json
from pathlib import Path

from benchmarks.thesis.__main__ import tables, write_report


def test_rows_with_a_measure_in_common_are_one_table():
    figures = {"ours.x1.late": 0.0, "ours.x1.lost": 0.5, "ram_mb": 300.0, "peer.x1.late": 0.1, "peer.x1.turns": 2.0}
    assert tables(figures) == [
        (["late", "lost", "turns"], {"ours.x1": {"late": 0.0, "lost": 0.5}, "peer.x1": {"late": 0.1, "turns": 2.0}}),
        (["ram_mb"], {"": {"ram_mb": 300.0}}),
    ]


def test_the_page_shows_figures_beside_one_another_with_their_goals(tmp_path: Path):
    figures = {"ours.ate_m": 0.02, "ours.way_m": 10.0, "reckoning.ate_m": 0.3}
    saved = {
        "about": "5.2 Mapping: `slam` < all.\n\nHow.", "quick": True, "figures": figures,
        "goals": {"ours.ate_m": 0.01, "reckoning.ate_m": 1.0},
    }  # fmt: skip
    (tmp_path / "slam.json").write_text(json.dumps(saved))
    write_report(tmp_path)
    markdown = (tmp_path / "index.md").read_text()
    assert "## 5.2 Mapping: `slam` < all." in markdown
    assert "|  | ate m | way m |" in markdown
    assert "| ours | 0.02 (at most 0.01: not met) | 10 |" in markdown
    assert "| reckoning | 0.3 (at most 1) |  |" in markdown
    assert "A quick look" in markdown
    page = (tmp_path / "index.html").read_text()
    assert "<h2>5.2 Mapping: <code>slam</code> &lt; all.</h2>" in page
    assert "<td>ours<td>0.02 (at most 0.01: not met)<td>10" in page
