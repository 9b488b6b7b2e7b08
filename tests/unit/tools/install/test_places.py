"""Where an installation writes: never through a link, never out of its root; and what it keeps of what was there."""

import os
from pathlib import Path
from typing import Any

import pytest

from monstertruck_runtime import small_files
from monstertruck_runtime.errors import InputError
from monstertruckd.tools.install import apply
from monstertruckd.tools.install.apply import Change, install, uninstall
from monstertruckd.tools.install.plan import RULES, UNIT
from tests.unit.tools.install.kit import TRUCK, truck_plan

INSTALLED = "etc/monstertruckd/truck.yaml"


def put(file: Path, text: str) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)
    return file


def link(root: Path, path: Path, target: str | Path) -> Path:
    place = root / path.relative_to("/")
    place.parent.mkdir(parents=True, exist_ok=True)
    place.symlink_to(target)
    return place


def files(root: Path) -> list[Path]:
    return [path for path in root.rglob("*") if path.is_file() and not path.is_symlink()]


def test_a_link_is_replaced_and_the_file_behind_it_stays_as_it_was(tmp_path: Path):
    root, theirs = tmp_path / "root", put(tmp_path / "theirs", "theirs")
    unit = link(root, UNIT, theirs)
    config = link(root, Path("/") / INSTALLED, theirs)
    report = install(truck_plan(root), root)
    assert report.changes[UNIT] is Change.CHANGED
    assert theirs.read_text() == "theirs"
    assert not unit.is_symlink()
    assert not config.is_symlink()
    assert config.read_text() == TRUCK.read_text()
    assert report.previous == []


@pytest.mark.parametrize("target", ["/dev/null", "../../../dev/null"])
def test_a_masked_unit_stays_masked(target: str, tmp_path: Path):
    unit = link(tmp_path, UNIT, target)
    assert install(truck_plan(tmp_path), tmp_path, dry=True).changes[UNIT] is Change.MASKED
    with pytest.raises(InputError, match=rf"is masked .*: systemctl --root={tmp_path} unmask monstertruckd.service"):
        install(truck_plan(tmp_path), tmp_path)
    assert unit.readlink() == Path(target)
    assert files(tmp_path) == [], "nothing at all was written"


def test_masked_rules_stay_masked(tmp_path: Path):
    place = link(tmp_path, RULES, os.devnull)
    with pytest.raises(InputError, match=f"is masked .*: rm {place}"):
        install(truck_plan(tmp_path), tmp_path)


def test_a_folder_that_leads_out_of_the_root_is_refused(tmp_path: Path):
    root, outside = tmp_path / "root", tmp_path / "outside"
    theirs = put(outside / UNIT.name, "theirs")
    link(root, UNIT.parent, outside)
    for attempt in (lambda: install(truck_plan(root), root), lambda: uninstall(root)):
        with pytest.raises(InputError, match=f"would be in {outside}.*, outside {root}"):
            attempt()
    assert theirs.read_text() == "theirs"
    assert files(root) == []


def test_a_folder_that_leads_elsewhere_in_the_root_is_followed(tmp_path: Path):
    link(tmp_path, UNIT.parent, "../../usr/lib/units")
    (tmp_path / "usr/lib/units").mkdir(parents=True)
    install(truck_plan(tmp_path), tmp_path)
    assert (tmp_path / "usr/lib/units" / UNIT.name).is_file()


def test_what_is_no_file_is_left_alone(tmp_path: Path):
    pipe = tmp_path / RULES.relative_to("/")
    pipe.parent.mkdir(parents=True)
    os.mkfifo(pipe)
    with pytest.raises(InputError, match=f"{pipe}: expected a file"):
        install(truck_plan(tmp_path), tmp_path)
    assert files(tmp_path) == []


def test_the_configuration_is_never_missing_while_it_is_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    install(truck_plan(tmp_path), tmp_path)
    installed = put(tmp_path / INSTALLED, "edited")
    installed.chmod(0o640)
    seen: list[tuple[str, str]] = []

    def look(path: Path, content: str, **options: Any) -> None:
        seen.append((path.name, path.read_text()))
        small_files.replace_file(path, content, **options)

    monkeypatch.setattr(apply, "replace_file", look)
    install(truck_plan(tmp_path), tmp_path)
    assert seen == [("truck.yaml", "edited")]
    previous = tmp_path / f"{INSTALLED}~"
    assert (previous.read_text(), previous.stat().st_mode & 0o777) == ("edited", 0o640)


def test_what_is_kept_is_the_newest_that_differed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    install(truck_plan(tmp_path), tmp_path)
    installed, previous = tmp_path / INSTALLED, tmp_path / f"{INSTALLED}~"
    for text in ("first", "second"):
        installed.write_text(text)
        install(truck_plan(tmp_path), tmp_path)
        assert previous.read_text() == text
    install(truck_plan(tmp_path), tmp_path)
    assert previous.read_text() == "second", "nothing was replaced"

    installed.unlink()
    installed.symlink_to(put(tmp_path / "copy", TRUCK.read_text()))
    install(truck_plan(tmp_path), tmp_path)
    assert previous.read_text() == "second", "the same text behind a link is no version of its own"

    installed.write_text("second")
    age = previous.stat().st_ino
    assert install(truck_plan(tmp_path), tmp_path).previous == [Path("/") / f"{INSTALLED}~"]
    assert (previous.read_text(), previous.stat().st_ino) == ("second", age)
