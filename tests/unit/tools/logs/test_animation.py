"""Drives as moving pictures."""

import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from monstertruck_estimation.transforms import mount
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import CommandFailedError, InputError
from monstertruck_schemas.sensor import SonarEcho, SonarRanges
from monstertruck_schemas.state import Transforms
from monstertruck_schemas.topics import ODOMETRY, SONAR, TRANSFORMS
from monstertruckd.recorder.reader import open_log
from monstertruckd.tools.cli.logs import app
from monstertruckd.tools.logs import animation
from monstertruckd.tools.logs.animation import BEAM, BODY, PLANNED, WALL, animate
from tests.unit.tools.logs.log_kit import Writer, odometry

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
    with pytest.raises(InputError, match=r"frames, at most 5: expected --speed 10 or more"):
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
    assert "cut.mcap: is damaged at byte" in done.output


def test_the_command_says_what_it_wrote(tmp_path: Path):
    file = tmp_path / "drive.gif"
    done = CliRunner().invoke(app, ["animate", str(GOLDEN), str(file), "--width", "64"])
    assert done.exit_code == 0, done.output
    assert done.output.startswith(f"{file}: ")


def test_what_sonars_heard_is_drawn_where_they_were(tmp_path: Path):
    writer = Writer(tmp_path / "sonar.mcap", config={"geometry": {"length": 0.32, "width": 0.3}})
    turned = mount("sonar_l", (0.1, 0.0, 0.0), (0.0, 0.0, math.pi / 2))
    writer.put(TRANSFORMS, Transforms(stamp=SECOND, received=SECOND, seq=0, transforms=(turned,)))
    for number in range(10):
        now = (1 + number) * SECOND // 2
        writer.put(ODOMETRY, odometry(now, number))
        echoes = (
            SonarEcho(name="l", range=1.0, stamp=now),
            SonarEcho(name="r", range=1.0, stamp=now),
            SonarEcho(name="l", answered=False, stamp=now),
        )
        ranges = SonarRanges(
            stamp=now, received=now, seq=number, sonars=echoes, field_of_view=0.5, range_min=0.02, range_max=3.0
        )
        writer.put(SONAR, ranges)
    writer.log.finish()
    scenes = animation._scenes(open_log(writer.log.path), SECOND, lambda _: None)
    for scene in scenes[1:]:
        (line,) = scene.arcs
        sonar = np.array([scene.pose[0] - 0.1 + 0.1, 0.0])  # of the round before this pose, 0.1 m back
        assert scene.points == pytest.approx(sonar[None] + (0.0, 1.0), abs=0.011)
        assert np.hypot(*(line - sonar).T) == pytest.approx(1.0)
        assert np.ptp(line[:, 0]) == pytest.approx(2 * math.sin(0.25))
    assert len(scenes) > 3
    file = tmp_path / "sonar.gif"
    animate(open_log(writer.log.path), file, speed=8.0, width=320)
    with Image.open(file) as picture:
        picture.seek(picture.n_frames - 1)
        assert {BEAM, WALL} <= colours(picture)
