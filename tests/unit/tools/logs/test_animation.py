"""Drives as moving pictures."""

from pathlib import Path

import pytest
from PIL import Image
from typer.testing import CliRunner

from monstertruck_runtime.errors import CommandFailedError, InputError
from monstertruckd.recorder.reader import open_log
from monstertruckd.tools.cli.logs import app
from monstertruckd.tools.logs import animation
from monstertruckd.tools.logs.animation import BEAM, BODY, PLANNED, WALL, animate

GOLDEN = min((Path(__file__).parents[3] / "data" / "golden").glob("*/run.mcap"))


def colours(frame: Image.Image) -> set[tuple[int, ...]]:
    return {colour for _, colour in frame.convert("RGB").getcolors(1 << 20)}


def test_the_truck_its_way_and_what_it_saw_are_drawn(tmp_path: Path):
    file = tmp_path / "drive.gif"
    figures = animate(open_log(GOLDEN), file, speed=4.0, width=320)
    with Image.open(file) as picture:
        assert (picture.n_frames, picture.width) == (figures["frames"], 320)
        assert picture.info["loop"] == 0
        first = picture.convert("RGB")
        picture.seek(picture.n_frames - 1)
        last = picture.convert("RGB")
    assert figures["frames"] > 5
    assert figures["bytes"] == file.stat().st_size
    assert {BEAM, BODY, WALL, PLANNED} <= colours(last)
    black = [[y for y in range(f.height) for x in range(f.width) if f.getpixel((x, y)) == BODY] for f in (first, last)]
    assert black[0]
    assert first.tobytes() != last.tobytes()


def test_twice_the_speed_takes_half_the_pictures(tmp_path: Path):
    slow, fast = (animate(open_log(GOLDEN), tmp_path / f"{s}.gif", speed=s, width=64)["frames"] for s in (2.0, 4.0))
    assert abs(slow - 2 * fast) <= 2


def test_what_cannot_be_drawn_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(animation, "MOST_FRAMES", 5)
    with pytest.raises(InputError, match=r"x\.png: expected a name that ends with \.gif"):
        animate(open_log(GOLDEN), tmp_path / "x.png", speed=8.0, width=320)
    with pytest.raises(InputError, match=r"pictures, at most 5: expected --speed 10 or more"):
        animate(open_log(GOLDEN), tmp_path / "x.gif", speed=1.0, width=320)
    monkeypatch.undo()
    with pytest.raises(CommandFailedError, match=r"x\.gif: No such file"):
        animate(open_log(GOLDEN), tmp_path / "nowhere" / "x.gif", speed=8.0, width=320)
    assert list(tmp_path.iterdir()) == []


def test_a_cut_log_is_drawn_and_ends_with_its_own_exit_code(tmp_path: Path):
    log = tmp_path / "cut.mcap"
    log.write_bytes(GOLDEN.read_bytes()[: GOLDEN.stat().st_size * 2 // 3])
    done = CliRunner().invoke(app, ["animate", str(log), str(tmp_path / "cut.gif"), "--width", "64"])
    assert done.exit_code == 9
    assert "cut.mcap: ends or is damaged after byte" in done.output


def test_the_command_says_what_it_wrote(tmp_path: Path):
    file = tmp_path / "drive.gif"
    done = CliRunner().invoke(app, ["animate", str(GOLDEN), str(file), "--width", "64"])
    assert done.exit_code == 0, done.output
    assert done.output.startswith(f"{file}: ")
