"""Hand drives in parts: what an earlier run drove counts, and is not driven again."""

import math
from argparse import Namespace
from collections import Counter
from concurrent.futures import ThreadPoolExecutor

from benchmarks import hand_drives
from benchmarks.hand_drives import Drive
from monstertruck_runtime.clock import SECOND


def test_drives_are_kept_for_the_next_run(tmp_path, monkeypatch):
    driven = []

    def drive(world: str, number: int, seed: int, confirm: float, scans_alone: bool) -> Drive:
        driven.append((world, number))
        return Drive(world, number, forward=1.5, backed=[0.03], reasons=Counter({"forward: obstacle_stop": 3}))

    monkeypatch.setattr(hand_drives, "OUTPUT", tmp_path / "drives.jsonl")
    monkeypatch.setattr(hand_drives, "ProcessPoolExecutor", ThreadPoolExecutor)
    monkeypatch.setattr(hand_drives, "driven", drive)
    monkeypatch.setattr(hand_drives, "digest", lambda options: str(options.seed))
    options = Namespace(
        worlds=("loop", "hall"), count=3, seed=1, confirm=0.0, scans_alone=False, jobs=1, minutes=math.inf
    )
    first = hand_drives.drives(options)
    assert driven == [("loop", 0), ("hall", 0), ("loop", 1)]
    assert hand_drives.drives(Namespace(**vars(options) | {"count": 4}))[:3] == first
    assert driven[3:] == [("hall", 1)], "the others are kept"
    hand_drives.drives(Namespace(**vars(options) | {"seed": 2, "count": 1}))
    assert driven[4:] == [("loop", 0)], "another seed is another drive"
    assert hand_drives.drives(Namespace(**vars(options) | {"minutes": 0.0, "seed": 3})) == []


def test_a_contact_that_only_scans_can_show_has_more_time():
    for within, unnoticed in ((hand_drives.NOTICED, 1), (hand_drives.NOTICED_BY_SCANS, 0)):
        drive = Drive("loop", 0, within)
        hand_drives.end_touch(hand_drives._Touch(0, "reverse", (0.0, 0.0)), round(0.4 * SECOND), drive)
        assert len(drive.unnoticed) == unnoticed
    assert hand_drives.truck("loop", 1, scans_alone=True).gate.contact.rise == 10.0
