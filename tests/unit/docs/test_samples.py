"""Samples of configuration in the pages are accepted as written, and samples of Python run."""

import os
import re
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import NamedTuple

import pytest
from typer.testing import CliRunner

from monstertruck_runtime.yaml_files import yaml_text
from monstertruckd.config.load import load_tree, load_truck
from monstertruckd.tools.cli.main import app
from monstertruckd.tools.driving.gamepad import read_mapping
from monstertruckd.tools.simulation.config import load_simulated
from tests.unit.docs.command_lines import PAGES, ROOT

BLOCK = re.compile(
    r"^```(?P<kind>\w+)\n(?P<fenced>.*?)^```$|(?<=\n\n)(?P<plain>(?: {4}[^\n]*\n)+)", re.DOTALL | re.MULTILINE
)
BASES = {
    ("behaviours", "peers"): "full.yaml",
    ("behaviours", "lidar_sonars"): "robots/truck.yaml",
    ("devices", "hokuyo_lx"): "robots/f1tenth.yaml",
    ("devices", "pca9685_esc"): "robots/donkeycar.yaml",
    ("devices", "rpicam-vid"): "robots/donkeycar.yaml",
    ("robots-of-today", "rpicam-vid"): "robots/donkeycar.yaml",
    ("docking", "docks"): "dock.yaml",
    ("exploration", "explorer"): "explore.yaml",
    ("mapping", "fusion"): "fusion.yaml",
    ("mapping", "slam"): "slam.yaml",
    ("navigation", "lap.csv"): "full.yaml",
    ("safety", "rear_sonars"): "truck.yaml",
}
"""Configurations that samples extend, by page and a word of the sample; the others extend ``goals.yaml``."""
ETC = "/etc/monstertruckd/security"
PLACES = {
    "monstertruckd.open_log": "tests/unit/docs/test_samples.py::test_the_sample_of_logs_runs",
    "import sys, zenoh": "tests/unit/bus/test_zenoh_session.py::test_the_ten_lines_of_the_docs_print_the_pose",
    "async with TruckClient": "tests/daemon/test_docs_wall.py::test_samples_of_clients_drive",
    "with Truck(": "tests/daemon/test_docs_wall.py::test_samples_of_clients_drive",
}
"""The test that runs a sample of Python, by a line of the sample."""


class Sample(NamedTuple):
    """A block of code on a page."""

    page: str
    number: int
    kind: str
    text: str


def samples() -> list[Sample]:
    """Return the blocks of YAML and Python, and those indented ones that begin with a key."""
    found = []
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for block in BLOCK.finditer(text):
            code = block["fenced"] or textwrap.dedent(block["plain"] or "")
            kind = block["kind"] or ("yaml" if re.match(r'\w+:( [{\["/]|\n)', code) else "text")
            if kind in {"yaml", "python"}:
                found.append(Sample(page.stem, text[: block.start()].count("\n") + 1, kind, code))
    return found


YAML = [sample for sample in samples() if sample.kind == "yaml"]
PYTHON = [sample for sample in samples() if sample.kind == "python"]


@pytest.fixture(scope="module")
def configs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The configurations, with the files that samples name beside them."""
    folder = tmp_path_factory.mktemp("samples") / "configs"
    shutil.copytree(ROOT / "configs", folder)
    shutil.copy(folder / "paths" / "loop.csv", folder / "lap.csv")
    (folder / "zones.yaml").write_text("zones: {}\n", encoding="utf-8")
    for name in ("keepout", "speed"):
        shutil.copy(folder / "worlds" / "rooms.yaml", folder / f"{name}.yaml")
    shutil.copy(folder / "worlds" / "rooms.png", folder)
    return folder


def _base(sample: Sample) -> str:
    found = [base for (page, word), base in BASES.items() if page == sample.page and word in sample.text]
    return (found or ["goals.yaml"])[0]


@pytest.mark.parametrize("sample", YAML, ids=lambda sample: f"{sample.page}:{sample.number}")
def test_a_sample_of_yaml_is_accepted(sample: Sample, configs: Path):
    file = configs / "sample.yaml"
    file.write_text(sample.text, encoding="utf-8")
    if sample.page == "command-line":
        assert read_mapping(file).name == "*Controller*"
        return
    base = configs / _base(sample)
    if "port:" in sample.text:
        base = _real(base, besides=file)
    if ETC in sample.text:
        place = configs.parent / "security"
        for words in (["init", "--address", "192.168.1.7", "--place", str(place / "robot")], ["add", "ann"]):
            done = CliRunner().invoke(app, ["security", *words, "--folder", str(place)])
            assert done.exit_code == 0, done.output
        file.write_text(sample.text.replace(ETC, str(place / "robot")), encoding="utf-8")
    whole = configs / "with_sample.yaml"
    whole.write_text(yaml_text({"include": [str(base), "sample.yaml"], "version": 2}), encoding="utf-8")
    (load_simulated if sample.text.startswith("sim:") else load_truck)(whole)


def _real(base: Path, besides: Path) -> Path:
    """Write ``base`` for a real robot, as docs/robots-of-today.md asks for: no simulation, a port for each device."""
    kept = re.split(r"^(?:stand|sim):", base.read_text(encoding="utf-8"), maxsplit=1, flags=re.MULTILINE)[0]
    robot = base.with_name("robot.yaml")
    robot.write_text(kept, encoding="utf-8")
    named = load_tree(besides).data["devices"]
    others = [name for name, row in load_tree(robot).data["devices"].items() if "port" not in row and name not in named]
    ports = {name: {"port": {"path": f"/dev/truck/{name}"}} for name in others}
    real = base.with_name("real.yaml")
    real.write_text(yaml_text({"include": robot.name, "version": 2, "devices": ports}), encoding="utf-8")
    return real


def test_the_sample_of_logs_runs(tmp_path: Path):
    (code,) = [sample.text for sample in PYTHON if sample.page == "logs"]
    (tmp_path / "logs").mkdir()
    shutil.copy(ROOT / "tests" / "data" / "replay" / "level.mcap", tmp_path / "logs" / "run-000001-000.mcap")
    environment = os.environ | {"MPLBACKEND": "agg"}
    ran = [sys.executable, "-c", code]
    ended = subprocess.run(ran, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr


def test_every_sample_of_python_is_run():
    places = {sample: [place for start, place in PLACES.items() if start in sample.text] for sample in PYTHON}
    assert [f"{sample.page}:{sample.number}" for sample, found in places.items() if len(found) != 1] == []
    for file, _, name in (place.partition("::") for place in PLACES.values()):
        assert f"def {name}(" in (ROOT / file).read_text(encoding="utf-8")
