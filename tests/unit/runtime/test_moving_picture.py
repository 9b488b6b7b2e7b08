"""GIFs that are written as they grow."""

import weakref
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from monstertruck_runtime.moving_picture import MovingPicture


def picture(number: int, colours: int = 4) -> Image.Image:
    """A square that wanders, in a palette of its own."""
    cells = np.full((40, 60), number % 2 if colours > 4 else 0, np.uint8)
    cells[10:20, number : number + 10] = 3
    made = Image.fromarray(cells).convert("P")
    made.putpalette([part for i in range(colours) for part in (60 * i % 256, 10 * colours, number % 3)])
    return made


def frames(file: Path) -> list[tuple[np.ndarray, int]]:
    """Pictures, and how long each stands, ms."""
    with Image.open(file) as image:
        found = []
        for number in range(image.n_frames):
            image.seek(number)
            found.append((np.asarray(image.convert("RGB")), image.info["duration"]))
    return found


def test_every_picture_is_what_was_added_and_what_did_not_change_stands_longer(tmp_path: Path):
    shown = [picture(number) for number in (0, 1, 1, 1, 2, 30)] + [picture(31, 16), picture(32, 16)]
    with MovingPicture(tmp_path / "a.gif", 0.1, 1.5) as made:
        for each in shown:
            made.add(each.copy())
    assert made.count == 8
    found = frames(tmp_path / "a.gif")
    assert [duration for _, duration in found] == [100, 300, 100, 100, 100, 1500]
    distinct = [shown[i] for i in (0, 1, 4, 5, 6, 7)]
    for (pixels, _), each in zip(found, distinct, strict=True):
        np.testing.assert_array_equal(pixels, np.asarray(each.convert("RGB")))


def test_a_long_one_takes_no_memory_and_what_is_not_begun_leaves_no_file(tmp_path: Path):
    with MovingPicture(tmp_path / "none.gif", 0.1):
        pass
    assert list(tmp_path.iterdir()) == []
    kept = []
    with MovingPicture(tmp_path / "a.gif", 0.1) as made:
        for number in range(40):
            each = picture(number)
            kept.append(weakref.ref(each))
            made.add(each)
            del each
        assert [reference() is None for reference in kept[:-2]] == [True] * 38
    assert len(frames(tmp_path / "a.gif")) == 40


def test_a_picture_that_stands_for_hours_is_repeated(tmp_path: Path):
    with MovingPicture(tmp_path / "a.gif", 300.0) as made:
        for _ in range(5):
            made.add(picture(1))
    found = frames(tmp_path / "a.gif")
    assert sum(duration for _, duration in found) == 1_500_000
    assert len(found) == 3


def test_one_that_is_broken_off_leaves_what_was_there(tmp_path: Path):
    file = tmp_path / "a.gif"
    with MovingPicture(file, 0.1) as made:
        for number in range(3):
            made.add(picture(number))
    whole = file.read_bytes()

    def broken_off() -> None:
        with MovingPicture(file, 0.1) as made:
            for number in range(3):
                made.add(picture(number))
            assert file.read_bytes() == whole, "what a process that is killed leaves"
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        broken_off()
    assert [path.name for path in tmp_path.iterdir()] == ["a.gif"]
    assert file.read_bytes() == whole
