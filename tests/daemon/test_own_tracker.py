"""The how-to of planners is followed to the letter: its tracker, installed outside the tree, drives the lap."""

import json
from pathlib import Path

import pytest

from tests.plugin_kit import ROOT, files_of, installed, run_with, written

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(300)]


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page's files, next to the configurations that they include."""
    folder = written(files_of("planner"), tmp_path_factory.mktemp("linear"))
    (folder / "configs").symlink_to(ROOT / "configs")
    return folder


@pytest.fixture(scope="module")
def target(project: Path) -> Path:
    """Where its wheel is installed."""
    return installed(project, project / "site")


def lap(target: Path, config: Path, folder: Path) -> dict[str, str]:
    """Figures of a lap, by name."""
    out = run_with(target, "demo", "--fast", "-c", str(config), "-o", str(folder))
    return dict(line.split("  ", 1) for line in out.splitlines() if "  " in line)


def centimetres(figures: dict[str, str]) -> float:
    return float(figures["cross-track RMS"].split()[0])


@pytest.mark.long
def test_it_drives_the_lap_in_the_loop_and_in_a_worker_and_its_settings_count(
    project: Path, target: Path, tmp_path: Path
):
    near = lap(target, project / "robot.yaml", tmp_path / "near")
    assert near["outcome"].strip() == "path driven to its end"
    assert centimetres(near) < 2.0
    slack = project / "slack.yaml"
    text = (project / "robot.yaml").read_text().replace("length: 0.25", "length: 1.0")
    slack.write_text(text + "placement: { tracker: worker }\n")
    assert centimetres(lap(target, slack, tmp_path / "far")) > 1.3 * centimetres(near)


@pytest.mark.long
def test_it_is_listed_and_its_settings_are_checked(project: Path, target: Path):
    rows = {row["name"]: row for row in json.loads(run_with(target, "plugins", "--json"))}
    assert rows["linear"]["origin"] == "truck-linear 1.0"
    assert rows["linear"]["error"] is None
    shown = run_with(target, "config", "show", str(project / "robot.yaml"))
    assert "damping" in shown
    bad = project / "bad.yaml"
    bad.write_text((project / "robot.yaml").read_text().replace("length:", "lenght:"))
    with pytest.raises(AssertionError, match=r"bad\.yaml:6: tracker\.lenght: unknown key \(did you mean length\?\)"):
        run_with(target, "config", "show", str(bad))
    with pytest.raises(AssertionError, match=r"robot\.yaml:4: tracker.*'linear'.*'pure_pursuit', 'fuzzy'"):
        run_with(project, "config", "show", str(project / "robot.yaml"))
