"""LeRobot data sets: frames, actions, video and figures, read back file by file."""

import io
import json

import av
import numpy as np
import pandas as pd
import pytest
from PIL import Image

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_schemas import topics as t
from monstertruck_schemas.cmd import DriveAction, DriveCommand, SteeringCommand
from monstertruck_schemas.sensor import CompressedImage
from monstertruckd.tools.logs.lerobot import export_lerobot
from monstertruckd.tools.logs.messages import Selection
from tests.unit.tools.logs.log_kit import Writer, clock, odometry


def picture(grey, size=(64, 48)):
    data = io.BytesIO()
    Image.new("RGB", size, (grey, grey, grey)).save(data, "jpeg")
    return data.getvalue()


def write(file, sizes=((64, 48),), *, commands=True):
    """Three seconds at 20 Hz: number ``i`` of each message says so in its values."""
    writer = Writer(file, config={"robot": "digger"})
    writer.put(t.CLOCK, clock(SECOND))
    for i in range(60):
        now = SECOND + i * SECOND // 20
        head = {"stamp": now, "received": now, "seq": i}
        writer.put(t.ODOMETRY, odometry(now, i))
        if commands:
            writer.put(t.CMD_DRIVE, DriveCommand(**head, action=DriveAction.RUN, speed=i / 100, motor_velocity=1.0))
            angles = {"front": i / 200, "rear": -i / 200, "front_servo": 0.0, "rear_servo": 0.0}
            writer.put(t.CMD_STEERING, SteeringCommand(**head, **angles))
        data = picture(4 * i, sizes[i % len(sizes)])
        writer.put(t.CAMERA, CompressedImage(**head, frame="camera", data=data, sequence=i))
    writer.log.finish()
    return file


def test_a_frame_holds_what_was_newest_at_its_time(tmp_path):
    root = tmp_path / "set"
    assert t.CMD_DRIVE.name in export_lerobot(write(tmp_path / "run.mcap", ((65, 49),)), root)
    rows = pd.read_parquet(root / "data/chunk-000/file-000.parquet")
    assert len(rows) == 30
    assert rows["action"][5].tolist() == pytest.approx([0.1, 0.05, -0.05])
    assert rows["observation.state"][5].tolist() == pytest.approx([1.0, 0, 0, 1, 0, 0])
    assert rows["timestamp"].tolist() == pytest.approx(np.arange(30) / 10)
    information = json.loads((root / "meta/info.json").read_text())
    assert (information["codebase_version"], information["robot_type"]) == ("v3.0", "digger")
    assert information["features"]["action"]["names"] == ["speed", "front", "rear"]
    video = root / information["video_path"].format(video_key="observation.images.camera", chunk_index=0, file_index=0)
    with av.open(str(video)) as container:
        frames = [(frame.time, frame.to_ndarray(format="rgb24")) for frame in container.decode(video=0)]
    assert [time for time, _ in frames] == pytest.approx(np.arange(30) / 10)
    assert frames[0][1].shape == (48, 64, 3)
    assert abs(frames[5][1].mean() - 40) < 4
    tasks = pd.read_parquet(root / "meta/tasks.parquet")
    assert tasks.loc["drive", "task_index"] == 0
    episode = pd.read_parquet(root / "meta/episodes/chunk-000/file-000.parquet").iloc[0]
    assert (episode["length"], episode["dataset_to_index"]) == (30, 30)
    figures = json.loads((root / "meta/stats.json").read_text())
    assert figures["action"]["max"] == pytest.approx([0.58, 0.29, 0.0], abs=1e-6)
    assert np.shape(figures["observation.images.camera"]["mean"]) == (3, 1, 1)


def test_what_makes_no_data_set_is_refused(tmp_path):
    log = write(tmp_path / "run.mcap")
    with pytest.raises(InputError, match="omit the option --topic"):
        export_lerobot(log, tmp_path / "set", Selection(("sensor/scan",)))
    still = write(tmp_path / "still.mcap", commands=False)
    with pytest.raises(InputError, match=r"still\.mcap: no message of cmd/drive"):
        export_lerobot(still, tmp_path / "set")
    changing = write(tmp_path / "changing.mcap", ((64, 48), (32, 24), (64, 48)))
    with pytest.raises(InputError, match="in one video"):
        export_lerobot(changing, tmp_path / "set")
    assert not (tmp_path / "set").exists()
    assert export_lerobot(log, tmp_path / "set", Selection(start=100.0)) == {}
    (tmp_path / "set").mkdir()
    with pytest.raises(InputError, match="already exists"):
        export_lerobot(log, tmp_path / "set")
