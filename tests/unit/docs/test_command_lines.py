"""Every command line of the documentation does what it says; those on a running truck are in test_docs_wall.py."""

import re
import shutil
import tomllib
from pathlib import Path

import pytest
from typer.testing import CliRunner

from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.cli.main import app
from tests.unit.docs.command_lines import (
    FOREIGN,
    INSTEAD,
    ROOT,
    SERVING,
    SHORTENED,
    Line,
    inline,
    is_ours,
    lines,
    needs_truck,
    options_of,
    ours,
    resolve,
    starts_truck,
)
from tests.unit.tools.logs.bag_kit import ROS1, ROS2, RosMessages, drive, write_ros1, write_ros2

pytestmark = pytest.mark.timeout(180)  # the first route of a computer compiles

RECORDED = ROOT / "tests" / "data" / "replay" / "level.mcap"


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the documentation's lines find what they name."""
    folder = tmp_path_factory.mktemp("desk")
    shutil.copytree(ROOT / "configs", folder / "configs")
    for logs in (folder / "logs", folder / "runs" / "demo" / "logs"):
        logs.mkdir(parents=True)
        shutil.copy(RECORDED, logs / "run-000001-000.mcap")
    installed = CliRunner().invoke(
        app, ["install-service", "--config", str(ROOT / "configs" / "truck.yaml"), "--root", str(folder / "system")]
    )
    assert installed.exit_code == 0, installed.output
    # For lines that add stations, whichever line is first.
    authority = CliRunner().invoke(app, ["security", "init", "--folder", str(folder / "security")])
    assert authority.exit_code == 0, authority.output
    for robot in ("ann", "bob"):
        for words in (["init", "--robot", robot], ["add", "desk"]):
            made = CliRunner().invoke(app, ["security", *words, "--folder", str(folder / robot / "security")])
            assert made.exit_code == 0, made.output
    rows = drive(RosMessages(ROS1))
    rows += [("/wheel_odometry", time, message) for topic, time, message in rows if topic == "/odom"]
    write_ros1(folder / "drive.bag", rows)
    write_ros2(folder / "rosbag2_2026_05_01", drive(RosMessages(ROS2)))
    built = CliRunner().invoke(app, ["map", "build", str(folder / "drive.bag"), "-o", str(folder / "runs" / "map")])
    assert built.exit_code == 0, built.output
    way = (ROOT / "configs" / "paths" / "loop.csv").read_text().splitlines(keepends=True)[:16]
    (folder / "short.csv").write_text("".join(way))
    for name in SHORTENED:
        (folder / f"short_{name}.yaml").write_text(
            f"include: configs/{name}.yaml\nversion: 2\npath: {{ file: short.csv, closed: false }}\n"
        )
    return folder


def test_the_pages_have_command_lines():
    assert len(ours()) > 20


@pytest.mark.parametrize("line", [line for line in lines() if not is_ours(line)], ids=lambda line: line.text)
def test_lines_of_other_programs_are_known(line: Line):
    assert line.text in FOREIGN, f"{line.place}: say in FOREIGN why {line.text!r} is not run"
    if extra := re.search(r"'\.\[(\w+)\]'", line.text):
        project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
        assert extra[1] in project["optional-dependencies"]
    if within := re.search(r" (monstertruckd [a-z][^/]*?)(?: /| -- |$)", line.text):
        _look_up(within[1].removesuffix(" --config"))
    for place in re.findall(
        r"(?: |/opt/monstertruckd/)((?:systemd|benchmarks|docs)/[\w/]+(?:\.py|/Dockerfile))", line.text
    ):
        assert (ROOT / place).is_file(), line.place
    if "ctl " in line.text:
        assert (ROOT / "systemd" / "monstertruckd.service").is_file()


@pytest.mark.parametrize("line", ours(), ids=lambda line: line.text)
def test_its_command_and_options_are_there(line: Line):
    _look_up(line.text)


def drives(line: Line) -> bool:
    """Whether it drives a simulated truck, which takes seconds."""
    return line.arguments[0] in {"demo", "drill"}


@pytest.mark.parametrize(
    "line",
    [
        pytest.param(line, marks=pytest.mark.long if drives(line) else ())
        for line in ours()
        if not needs_truck(line) and not starts_truck(line) and line.text not in SERVING
    ],
    ids=lambda line: line.text,
)
def test_it_runs(line: Line, desk: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(desk)
    instead = INSTEAD.get(line.text)
    if instead is not None and instead.line is None:
        _look_up(line.text)
        return
    arguments = Line(line.place, instead.line).arguments if instead and instead.line else line.arguments
    done = CliRunner().invoke(app, arguments, input="a long password\n" * 2)
    assert not isinstance(done.exception, Exception), done.exception
    if instead is not None and instead.code is None:
        assert done.exit_code in {reason.exit_code for reason in Reason} - {Reason.INTERNAL.exit_code}, done.output
    else:
        assert done.exit_code == (0 if instead is None else instead.code), f"{line.place}: {done.output}"


def test_nothing_is_replaced_that_is_not_there():
    there = {line.text for line in lines()}
    assert there >= INSTEAD.keys()
    assert there >= FOREIGN.keys()
    assert there >= set(SERVING)


def test_the_tests_that_reasons_name_are_there():
    reasons = [*(instead.why for instead in INSTEAD.values()), *FOREIGN.values()]
    named = {
        name for text in reasons for name in re.findall(r"(?:(?:tests|benchmarks)/[\w/]*)?\b\w+\.py|tests/\S+", text)
    }
    there = [
        file.relative_to(ROOT).as_posix() for top in ("tests", "benchmarks") for file in (ROOT / top).rglob("*.py")
    ]
    assert len(named) > 10
    assert [
        name for name in named if not any(f"/{file}".endswith(f"/{name}") or f"{name}/" in file for file in there)
    ] == []


@pytest.mark.parametrize(("page", "text"), sorted(set(inline())), ids=lambda word: word)
def test_what_sentences_name_is_there(page: str, text: str):
    if "benchmarks/" in text:
        assert (ROOT / text.removeprefix("python ").split()[0]).is_file(), page
    else:
        _look_up(text)


@pytest.mark.parametrize("file", sorted((ROOT / "configs").rglob("*.yaml")), ids=lambda file: file.name)
def test_what_the_head_of_a_configuration_names_is_there(file: Path):
    head = file.read_text(encoding="utf-8")
    for text in re.findall(r"# .*?(?=monstertruckd [a-z])(.+)", head):
        for call in re.findall(r"monstertruckd [a-z][^,`(;#]*", text):
            _look_up(call.strip())


def _look_up(text: str) -> None:
    words = text.split()[1:]
    if words[0] in {"--install-completion", "--help"}:
        return
    command, rest = resolve([word for word in words if not word.endswith(">")] if "<" in text else words)
    options = {word.partition("=")[0] for word in rest if re.match(r"--?[a-z]", word)}
    assert options <= options_of(command), (text, options - options_of(command))
