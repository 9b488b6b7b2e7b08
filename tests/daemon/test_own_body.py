"""The how-to of robot bodies is followed to the letter: its robot, from a package outside the tree, drives its bend."""

import json
from pathlib import Path

import pytest

from tests.plugin_kit import ROOT, files_of, installed, run_with, written

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(180)]


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page's files, next to the configurations that they include."""
    folder = written(files_of("robot_body"), tmp_path_factory.mktemp("tracked"))
    (folder / "configs").symlink_to(ROOT / "configs")
    return folder


@pytest.fixture(scope="module")
def target(project: Path) -> Path:
    """Where its wheel is installed."""
    return installed(project, project / "site")


@pytest.mark.long
def test_it_drives_its_bend(project: Path, target: Path, tmp_path: Path):
    out = run_with(target, "demo", "--fast", "-c", str(project / "robot.yaml"), "-o", str(tmp_path / "run"))
    figures = dict(line.split("  ", 1) for line in out.splitlines() if "  " in line)
    assert figures["outcome"].strip() == "path driven to its end"
    assert float(figures["cross-track RMS"].split()[0]) < 3.0
    assert {"sensor/drive", "sensor/drive_2"} <= {line.split()[0] for line in out.splitlines() if line.strip()}


@pytest.mark.long
def test_it_is_listed_and_its_settings_are_checked(project: Path, target: Path):
    rows = {row["name"]: row for row in json.loads(run_with(target, "plugins", "--json"))}
    assert (rows["tracked"]["origin"], rows["tracked"]["error"]) == ("truck-tracked 1.0", None)
    bad = project / "bad.yaml"
    bad.write_text((project / "robot.yaml").read_text().replace("ratio: 1.6 ", "ratio: 9 "))
    with pytest.raises(AssertionError, match=r"bad\.yaml:5: body\.steering_ratio: .*less than or equal to 4"):
        run_with(target, "config", "show", str(bad))
    bad.write_text((project / "robot.yaml").read_text().replace("  drive_2:", "  drive_3:"))
    with pytest.raises(AssertionError, match=r"body tracked is driven by drive \(left\), drive_2 \(right\)"):
        run_with(target, "config", "show", str(bad))
