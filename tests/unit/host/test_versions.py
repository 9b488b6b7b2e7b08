"""A log says what ran."""

import shutil
import subprocess
from pathlib import Path

import pytest

from monstertruckd import __version__
from monstertruckd.host import versions


def test_versions_of_everything_a_log_may_have_to_be_explained_by():
    found = versions.running_versions()
    assert found["monstertruckd"] == __version__
    assert {"python", "machine", "kernel", "system", "numpy", "eclipse-zenoh"} <= found.keys()
    assert all(found.values())


@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
def test_a_checkout_is_known_by_its_commit_and_whether_it_was_touched(tmp_path: Path):
    def git(*arguments):
        identity = ("-c", "user.name=x", "-c", "user.email=x@example.org")
        subprocess.run(["git", "-C", str(tmp_path), *identity, *arguments], check=True, capture_output=True)

    assert versions.checkout(tmp_path) is None, "no checkout"
    git("init")
    assert versions.checkout(tmp_path) is None, "without a commit"
    (tmp_path / "file").write_text("1")
    git("add", "file")
    git("commit", "-m", "x")
    commit = versions.checkout(tmp_path)
    assert commit is not None
    assert len(commit) == 12
    (tmp_path / "file").write_text("2")
    assert versions.checkout(tmp_path) == f"{commit}-dirty"


def test_without_git_nothing_is_said_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / ".git").mkdir()
    monkeypatch.setenv("PATH", "")
    assert versions.checkout(tmp_path) is None
