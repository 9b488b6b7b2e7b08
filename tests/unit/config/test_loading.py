"""YAML with origins: merging, and one clear line for every mistake."""

import os
from pathlib import Path
from time import process_time
from typing import Annotated, ClassVar, Literal

import pytest
from pydantic import Field

from monstertruck_runtime.errors import ConfigError
from monstertruck_schemas import entry_points
from monstertruck_schemas.base import Schema
from monstertruck_schemas.entry_points import Broken
from monstertruckd.config.load import included, load_config, load_tree, resolved
from monstertruckd.config.migrate import plan


class Wheel(Schema):
    radius: Annotated[float, Field(gt=0, le=1)] = 0.075
    """Metres from hub to ground"""
    count: int = 4


class Lidar(Schema):
    kind: Literal["lidar"] = "lidar"
    beams: int = 682


class Sonar(Schema):
    kind: Literal["sonar"] = "sonar"
    cone: float = 0.87


class Root(Schema):
    FILE_KEYS: ClassVar[tuple[tuple[str, ...], ...]] = (("map",),)
    version: Literal[2]
    name: str
    wheel: Wheel = Wheel()
    sensors: tuple[Annotated[Lidar | Sonar, Field(discriminator="kind")], ...] = ()
    map: Path | None = None
    spare: bool = False


def write(folder: Path, text: str, name: str = "truck.yaml") -> Path:
    file = folder / name
    file.write_text(text)
    return file


def complaint(folder: Path, text: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load_config(write(folder, text), Root)
    return str(caught.value)


def test_a_good_file(tmp_path: Path):
    config, tree = load_config(
        write(tmp_path, "version: 2\nname: t\nwheel:\n  radius: 0.1\nsensors:\n  - {kind: sonar, cone: 1}\n"), Root
    )
    assert config.wheel == Wheel(radius=0.1)
    assert config.sensors == (Sonar(cone=1.0),)
    assert str(tree.origin(("wheel", "radius"))) == f"{tmp_path / 'truck.yaml'}:4"
    assert resolved(config)["wheel"] == {"radius": 0.1, "count": 4}


def test_a_map_may_be_the_folder_of_a_saved_one(tmp_path: Path):
    (tmp_path / "saved").mkdir()
    file = write(tmp_path, "version: 2\nname: t\nmap: saved\n")
    with pytest.raises(ConfigError, match="no saved map in this folder"):
        load_config(file, Root)
    for name in ("map.yaml", "saves/000001/map.yaml"):
        (tmp_path / "saved" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "saved" / name).touch()
        assert load_config(file, Root)[0].map == tmp_path / "saved"
        (tmp_path / "saved" / name).unlink()


@pytest.mark.parametrize(
    ("text", "line", "expected"),
    [
        ("version: 2\nname: t\nwhele: {}\n", 3, "whele: unknown key (did you mean wheel?)"),
        ("version: 2\nname: t\nwheel:\n  radios: 1\n", 4, "wheel.radios: unknown key (did you mean radius?)"),
        ("version: 2\nname: t\nwheel:\n  zzz: 1\n", 4, "wheel.zzz: unknown key; expected one of count, radius"),
        (
            "version: 2\nname: t\nwheel:\n  radius: 75\n",
            4,
            "equal to 1, found 75 (Metres from hub to ground)",
        ),
        ("version: 2\nname: t\nwheel:\n  radius: 7.5 cm\n", 4, "found '7.5 cm' (Metres from hub to ground)"),
        ("version: 2\nname: t\nwheel:\n  count: 1.5\n", 4, "wheel.count: "),
        ("version: 2\n", 1, "name: missing; it has no default"),
        ("version: 3\nname: t\n", 1, "version: expected 1 to 2, found 3"),
        ("name: t\n", 1, "version: missing; write `version: 2`"),
        ("version: 2\nsteps: []\non_failure: return\n", 1, "another kind of file: expected name, found steps, on_fai"),
        ("version: 2\nname: t\nname: u\n", 3, "name: given twice in one section"),
        ("version: 2\nname: t\nmap: nowhere.yaml\n", 3, "map: no such file"),
        ("version: 2\nname: t\ninclude: nowhere.yaml\n", 3, "include: no such file"),
        (f"version: 2\nname: t\ninclude: {'a' * 300}.yaml\n", 3, "include: cannot be read: File name too long"),
        (f"version: 2\nname: t\nmap: {'a' * 300}.yaml\n", 3, "map: cannot be read: File name too long"),
        ('version: 2\nname: t\nmap: "a\\0.yaml"\n', 3, "map: expected a file name: embedded null byte"),
        ("version: 2\nname: t\ninclude: 7\n", 3, "include: expected a file name or a list"),
        ("version: 2\nname: t\nwheel: [1]\n", 3, "wheel: "),
        ("version: 2\nname: [t\n", 3, "not valid YAML"),
        ("- 1\n", 1, "expected a mapping of sections, found a list"),
        ("version: 2\nname: t\n? [a]\n: 1\n", 3, "a key must be plain text"),
        ("version: 2\nname: t\nsensors:\n  - {kind: radar}\n", 4, "sensors.0"),
        ("version: 2\nname: t\nsensors:\n  - kind: sonar\n    beems: 3\n", 5, "sensors.0.beems: unknown key"),
        ("version: 2\nname: t\nsensors:\n  - kind: sonar\n    beems: 3\n", 5, "expected one of cone, kind"),
        ("version: 2\nname: 2026-11-21\n", 1, "not text, a number, a list or a mapping"),
        ("version: 2\nname: a\x01\n", 2, "not valid YAML: character"),
        ("version: 2\nname: t\nspare: yes\n", 3, "found 'yes': write true or false"),
        ("version: 2\nname: .nan\nwheel:\n  radius: .nan\n", 2, "name: "),
    ],
)
def test_every_mistake_names_file_line_and_expectation(tmp_path: Path, text: str, line: int, expected: str):
    said = complaint(tmp_path, text)
    assert f"{tmp_path / 'truck.yaml'}:{line}" in said or "not text" in expected
    assert expected in said


def test_a_plug_in_that_was_left_out_is_named_with_an_unknown_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    broken = Broken("monstertruck.devices", "mb7360", "truck-sonar 1.0", "baud: expected a valid integer, found '9'")
    monkeypatch.setitem(entry_points._LEFT_OUT, broken.group, (broken,))
    said = complaint(tmp_path, "version: 2\nname: t\nranger: {}\n").splitlines()
    assert said[1] == f"plug-in skipped: {broken}"
    assert "plug-in" not in complaint(tmp_path, "version: 2\nname: []\n")


BOMB = "version: 2\nname: t\na0: &a0 [1, 1]\n" + "".join(
    f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]\n" for n in range(1, 12)
)


@pytest.mark.parametrize(
    ("text", "line", "expected"),
    [
        ("version: 2\na: &a [*a]\n", 2, "an alias in its own anchor"),
        ("version: 2\na: &a {b: {c: *a}}\n", 2, "an alias in its own anchor"),
        (BOMB, 3, "more than 20000 values"),
        ("# mine\n%YAML 1.1\n---\nversion: 2\nspare: yes\n", 2, "%YAML 1.1: expected YAML 1.2"),
        ("version: 2\nname: a\0b\n", 2, r"not valid YAML: character '\x00' is not allowed"),
        ("version: 2\nname:\n  " + "[" * 5000, 3, "nested more than 50 times"),
        ("version: 2\nname:\n" + "".join(f"{' ' * n}a:\n" for n in range(1, 900)), 51, "nested more than 50 times"),
        (
            "version: 2\n" + "".join(f"k{n}: &a{n} {n}\n" for n in range(19_000)),
            2500,
            "more than 5000 keys and values",
        ),
        ("version: 2\nname: [" + "1," * 200_000 + "1]", 2, "more than 5000 keys and values"),
    ],
    ids=["cycle", "deep cycle", "bomb", "YAML 1.1", "NUL", "flow", "block", "keys", "list"],
)
def test_hostile_text_is_one_clear_line_and_soon(tmp_path: Path, text: str, line: int, expected: str):
    file = write(tmp_path, text)
    begin = process_time()
    with pytest.raises(ConfigError) as caught:
        load_config(file, Root)
    assert process_time() - begin < 3  # 0.3 s on a quiet computer; read to its end the list alone takes 9
    assert str(caught.value).startswith(f"{file}:{line}: ")
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_would_be_read_for_ever_is_refused(tmp_path: Path):
    os.mkfifo(tmp_path / "pipe.yaml")
    long = write(tmp_path, "name: " + "x" * 5_000_000)
    for name, why in (
        (tmp_path / "pipe.yaml", "Not a regular file"),
        (Path("/dev/zero"), "Not a regular file"),
        (long, "5000006 bytes, expected at most 1000000"),
    ):
        with pytest.raises(ConfigError, match=f"{name}: cannot be read: {why}"):
            load_config(name, Root)


def test_of_many_mistakes_the_first_are_named(tmp_path: Path):
    file = write(tmp_path, "version: 2\nname: t\nwheel:\n" + "".join(f"  k{n}: {n}\n" for n in range(2000)))
    begin = process_time()
    with pytest.raises(ConfigError) as caught:
        load_config(file, Root)
    assert process_time() - begin < 1
    lines = str(caught.value).splitlines()
    assert len(lines) == 51
    assert lines[-1].endswith("more mistakes")


def test_yaml_1_2_may_be_declared_and_values_repeated(tmp_path: Path):
    config, _ = load_config(write(tmp_path, "%YAML 1.2\n---\nversion: 2\nname: &n t\nwheel: {radius: 0.1}\n"), Root)
    assert config.name == "t"
    tree = load_tree(write(tmp_path, "a: &a {b: [1, 2]}\nc: *a\nd: *a\n"))
    assert tree.data == {name: {"b": [1, 2]} for name in "acd"}


def test_numbers_are_those_of_yaml_1_2(tmp_path: Path):
    config, _ = load_config(write(tmp_path, "version: 2\nname: t\nwheel: {radius: 1e-1, count: 0o17}\n"), Root)
    assert config.wheel == Wheel(radius=0.1, count=15)


def test_several_mistakes_are_several_lines(tmp_path: Path):
    said = complaint(tmp_path, "version: 2\nname: 3\nwheel:\n  radios: 1\n  count: many\n")
    assert len(said.splitlines()) == 3


def test_an_unreadable_file_is_named(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"absent.yaml: cannot be read: No such file"):
        load_tree(tmp_path / "absent.yaml")
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="not UTF-8"):
        load_tree(tmp_path / "binary.yaml")


def test_includes_merge_deeply_and_later_wins(tmp_path: Path):
    write(tmp_path, "wheel: {radius: 0.2, count: 3}\nname: base\n", "base.yaml")
    write(tmp_path, "wheel: {count: 6}\nsensors: [{kind: lidar}]\n", "more.yaml")
    top = write(tmp_path, "include: [base.yaml, more.yaml]\nversion: 2\nwheel:\n  radius: 0.3\n")
    config, tree = load_config(top, Root)
    assert config.name == "base"
    assert config.wheel == Wheel(radius=0.3, count=6)
    origins = {key: tree.origin(key) for key in (("wheel", "radius"), ("wheel", "count"), ("name",))}
    assert [str(origin.file.name) for origin in origins.values() if origin] == ["truck.yaml", "more.yaml", "base.yaml"]


def test_another_kind_drops_the_keys_of_the_included_one(tmp_path: Path):
    write(tmp_path, "tracker: {kind: pure_pursuit, lookahead: 0.3}\n", "base.yaml")
    write(tmp_path, "include: base.yaml\ntracker:\n  kind: lqr\n", "other.yaml")
    write(tmp_path, "include: base.yaml\ntracker: {kind: pure_pursuit, speed: 0.1}\n", "same.yaml")
    other, same = load_tree(tmp_path / "other.yaml"), load_tree(tmp_path / "same.yaml")
    assert other.data["tracker"] == {"kind": "lqr"}
    assert ("tracker", "lookahead") not in other.origins
    assert str(other.origins["tracker", "kind"]) == f"{tmp_path / 'other.yaml'}:3"
    assert same.data["tracker"] == {"kind": "pure_pursuit", "lookahead": 0.3, "speed": 0.1}


def test_files_are_relative_to_the_file_that_names_them(tmp_path: Path):
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "arena.yaml").touch()
    write(tmp_path, "map: arena.yaml\n", "sub/maps.yaml")
    config, _ = load_config(write(tmp_path, "include: sub/maps.yaml\nversion: 2\nname: t\n"), Root)
    assert config.map == tmp_path / "sub" / "arena.yaml"


def test_a_circle_of_includes_is_refused(tmp_path: Path):
    write(tmp_path, "include: truck.yaml\n", "other.yaml")
    with pytest.raises(ConfigError, match="includes itself"):
        load_tree(write(tmp_path, "include: other.yaml\n"))


def test_an_include_leads_behind_a_linked_folder_as_the_system_does(tmp_path: Path):
    (tmp_path / "robots/mine").mkdir(parents=True)
    (tmp_path / "etc").symlink_to(tmp_path / "robots/mine")
    write(tmp_path, "version: 2\nrobot: t\n", "robots/base.yaml")
    write(tmp_path, "version: 2\ninclude: ../base.yaml\n", "robots/mine/truck.yaml")
    assert load_tree(tmp_path / "etc/truck.yaml").data == {"version": 2, "robot": "t"}
    assert [upgrade.path for upgrade in plan(tmp_path / "etc/truck.yaml")] == []
    assert included(tmp_path / "robots/mine/truck.yaml", "../base.yaml") == tmp_path / "robots/base.yaml"


def test_a_link_to_itself_is_one_line(tmp_path: Path):
    (tmp_path / "loop.yaml").symlink_to("loop.yaml")
    for read in (load_tree, plan):
        with pytest.raises(ConfigError, match=r"loop\.yaml.*symbolic links"):
            read(tmp_path / "loop.yaml")


def test_an_empty_file_is_an_empty_tree(tmp_path: Path):
    assert load_tree(write(tmp_path, "")).data == {}
