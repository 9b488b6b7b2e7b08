"""Distributions that documentation pages show (``docs/examples/``), installed outside the tree without network."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from monstertruck_schemas import entry_points

ROOT = Path(__file__).resolve().parents[1]


def files_of(example: str) -> dict[str, str]:
    """Files of a package in ``docs/examples``, by their places in it."""
    folder = ROOT / "docs" / "examples" / example
    files = [file for file in folder.rglob("*") if file.suffix in {".py", ".toml", ".yaml"}]
    return {file.relative_to(folder).as_posix(): file.read_text(encoding="utf-8") for file in files}


def written(files: dict[str, str], folder: Path) -> Path:
    """The files in ``folder``."""
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return folder


def installed(project: Path, target: Path) -> Path:
    """Build the wheel of ``project`` and unpack it into ``target``, which then belongs on the path of a process.

    That is all an installer does for a wheel of pure Python; its entry points are found there.
    """
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(project / "dist")]
    subprocess.run(build, cwd=project, check=True, capture_output=True)
    (wheel,) = (project / "dist").glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(target)
    return target


def run_with(target: Path, *arguments: str, cwd: Path = ROOT) -> str:
    """Run the command line in a process that sees what is installed in ``target``.

    Returns:
        What it printed on standard output.

    Raises:
        AssertionError: it failed; the text is what it printed.
    """
    ended = subprocess.run(
        [sys.executable, "-m", "monstertruckd", *arguments],
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": str(target)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Installs a distribution with one module and entry points (``group:name``) for this process, in addition."""
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(entry_points, "_LEFT_OUT", {})

    def put(distribution, module, text, places):
        (tmp_path / f"{module}.py").write_text(text)
        info = tmp_path / f"{distribution}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.0\n")
        groups = {}
        for name, place in places.items():
            group, _, entry = name.partition(":")
            groups.setdefault(group, []).append(f"{entry} = {place}\n")
        (info / "entry_points.txt").write_text("".join(f"[{g}]\n{''.join(lines)}" for g, lines in groups.items()))
        monkeypatch.delitem(sys.modules, module, raising=False)
        entry_points._installed.cache_clear()

    entry_points._installed.cache_clear()
    yield put
    entry_points._installed.cache_clear()
