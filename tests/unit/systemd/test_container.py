"""The container file and the development container name what the repository has."""

import json
import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest

from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT
from monstertruckd import bootstrap
from monstertruckd.station.server import Place

ROOT = Path(__file__).resolve().parents[3]
FILE = ROOT / "systemd" / "container" / "Dockerfile"
TEXT = FILE.read_text(encoding="utf-8")


def test_the_container_file_installs_extras_and_the_uv_that_there_are():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    wanted = re.findall(r"--extra (\S+)", TEXT)
    assert {*bootstrap.EXTRAS["try"], *bootstrap.EXTRAS["demo"]} <= set(wanted) <= set(extras)
    assert re.findall(r"uv==(\S+)", TEXT) == [bootstrap.UV_VERSION]


def test_the_container_file_runs_as_a_user_without_rights():
    steps = [line.split()[0] for line in TEXT.splitlines() if line[:1].isalpha()]
    assert steps[0] == "FROM"
    assert steps[-2:] == ["ENTRYPOINT", "CMD"]
    assert TEXT.index("USER 1000") > TEXT.rindex("RUN ")


def test_the_image_leaves_out_the_environment_and_history_of_the_clone():
    left_out = (ROOT / ".dockerignore").read_text(encoding="utf-8").split()
    assert {".git", ".venv", "**/__pycache__", "runs"} <= set(left_out)


@pytest.mark.skipif(shutil.which("hadolint") is None, reason="needs hadolint")
def test_the_container_file_passes_its_linter():
    done = subprocess.run(["hadolint", "--ignore", "DL3008", FILE], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


def test_the_development_container_sets_up_what_the_tests_need():
    settings = json.loads((ROOT / ".devcontainer" / "devcontainer.json").read_text(encoding="utf-8"))
    command = settings["postCreateCommand"].split()
    assert command[:3] == ["python3", "-m", "monstertruckd.bootstrap"]
    assert command[3] in bootstrap.EXTRAS


def test_the_development_container_forwards_the_ports_of_robot_and_page():
    settings = json.loads((ROOT / ".devcontainer" / "devcontainer.json").read_text(encoding="utf-8"))
    assert settings["forwardPorts"] == [int(DEFAULT_ENDPOINT.rpartition(":")[2]), Place().port]
