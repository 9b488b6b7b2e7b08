"""What a shell completes."""

import subprocess
import sys
from pathlib import Path

import pytest

from monstertruckd.tools.cli.options import complete_config, complete_device, complete_role, complete_topic

ROOT = Path(__file__).resolve().parents[4]


def test_names_of_topics_devices_and_roles():
    assert ("sensor/scan", "Lidar revolution") in list(complete_topic("sensor/s"))
    assert all(name.startswith("sensor/s") for name, _ in complete_topic("sensor/s"))
    assert list(complete_device("hok")) == [("hokuyo_urg", "lidar"), ("hokuyo_lx", "lidar")]
    assert list(complete_device("lid")) == [("lidar", "hokuyo_urg"), ("lidar_2", "hokuyo_urg")]
    assert complete_role("drive") == ["drive", "drive_2", "drive_3", "drive_4"]


def test_configurations_of_the_folder(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(ROOT)
    assert complete_config("configs/d") == ["configs/demo.yaml", "configs/dock.yaml"]
    assert "configs/robots/omni.yaml" in complete_config("")
    assert complete_config("go") == ["goals"], "a bundled one"
    assert "robots/omni" in complete_config("robots/")
    assert complete_config("elsewhere/") == [], "the shell completes files itself"


def test_a_shell_gets_them():
    asked = {"_MONSTERTRUCKD_COMPLETE": "complete_bash", "COMP_WORDS": "monstertruckd echo state/ga", "COMP_CWORD": "2"}
    done = subprocess.run(
        [sys.executable, "-c", "from monstertruckd.tools.cli.main import app; app(prog_name='monstertruckd')"],
        cwd=ROOT,
        env={"PATH": "/usr/bin", **asked},
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )
    assert done.stdout.split() == ["state/gate"], done.stderr
