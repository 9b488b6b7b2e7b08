"""The habit all commands share: values, tables, progress and ends."""

import fcntl
import json
import os
import pty
import signal
import struct
import subprocess
import sys
import termios
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from monstertruck_runtime.errors import ConfigError, NotFoundError, RequestRefusedError, TruckError
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.reasons import Reason
from monstertruck_sim.console import CommandedGroup, FaultConsole
from monstertruckd.config.calibration import Estimate, Result
from monstertruckd.tools.cli.calibrate import _print
from monstertruckd.tools.cli.main import app
from monstertruckd.tools.cli.output import (
    HELP_STYLE,
    CommandGroup,
    finish,
    print_end,
    print_json,
    print_table,
    print_words,
    progress,
    remark,
    until_stopped,
)
from monstertruckd.tools.logs.summary import LogState, list_logs

ROOT = Path(__file__).resolve().parents[4]


def ending(command: Callable[[], None]) -> int:
    """Exit code of a command line with this one command."""
    line = typer.Typer(cls=CommandGroup)
    line.callback()(lambda: None)
    line.command("do")(command)
    with pytest.raises(SystemExit) as ended:
        line(["do"])
    return int(ended.value.code or 0)


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (ConfigError("a.yaml:3: wrong"), 2),
        (NotFoundError("no such robot"), 4),
        (RequestRefusedError(Reason.OBSTACLE_STOP, "a wall"), 56),
    ],
)
def test_an_error_is_one_sentence_and_its_reasons_code(
    error: TruckError, code: int, capsys: pytest.CaptureFixture[str]
):
    def command() -> None:
        raise error

    assert ending(command) == code
    streams = capsys.readouterr()
    assert (streams.out, streams.err) == ("", f"{error}\n")


def test_an_error_of_a_task_among_others_is_one_sentence_too(capsys: pytest.CaptureFixture[str]):
    def command() -> None:
        raise ExceptionGroup("tasks", [ValueError("a bug"), ExceptionGroup("more", [NotFoundError("no such robot")])])

    assert ending(command) == Reason.NOT_FOUND.exit_code
    assert capsys.readouterr().err == "no such robot\n"


def test_a_missing_package_is_one_sentence(capsys: pytest.CaptureFixture[str]):
    def command() -> None:
        import no_such_package  # noqa: F401

    assert ending(command) == Reason.NOT_INSTALLED.exit_code
    assert "no_such_package is not installed: install the extra that contains it" in capsys.readouterr().err


def test_an_interrupt_gives_up_but_is_the_ordinary_end_of_what_runs_until_stopped():
    def finite() -> None:
        try:
            signal.raise_signal(signal.SIGTERM)
        finally:
            signal.raise_signal(signal.SIGTERM)  # timeout(1) sends two: the second one disturbs no end

    def endless() -> None:
        async def main(clock: object) -> None:
            signal.raise_signal(signal.SIGTERM)
            await clock.sleep(10.0)  # type: ignore[attr-defined]

        until_stopped(main)

    before = signal.getsignal(signal.SIGTERM)
    assert ending(finite) == Reason.CANCELLED.exit_code
    assert ending(endless) == 0
    assert signal.getsignal(signal.SIGTERM) is before


def test_sigterm_counts_where_ctrl_c_is_ignored():
    """As for a job that a script starts in the background."""

    def command() -> None:
        async def main(clock: object) -> None:
            signal.raise_signal(signal.SIGTERM)
            await clock.sleep(10.0)  # type: ignore[attr-defined]

        until_stopped(main)

    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        assert ending(command) == 0
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_reader_that_leaves_is_no_failure():
    read, write = os.pipe()
    process = subprocess.Popen(
        [sys.executable, "-m", "monstertruckd", "topics"], cwd=ROOT, stdout=write, stderr=subprocess.PIPE, text=True
    )
    os.close(read)
    os.close(write)
    _, errors = process.communicate(timeout=30)
    assert (process.returncode, errors) == (0, "")


def called(*arguments: str, **streams: Any) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "monstertruckd", *arguments]
    return subprocess.run(command, cwd=ROOT, text=True, timeout=30, check=False, **streams)


def test_a_full_disk_behind_standard_output_is_one_sentence():
    with open("/dev/full", "w") as full:  # noqa: PTH123 - a device
        done = subprocess.run(
            [sys.executable, "-m", "monstertruckd", "topics"],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            timeout=60,
        )
    assert (done.returncode, done.stderr) == (Reason.DISK_FULL.exit_code, "No space left on device\n")


def test_help_and_usage_errors_are_bare_lines_in_pipes():
    reported = called("log", "--help", capture_output=True).stdout
    assert reported.isascii()
    report = "Write one HTML page about a log: path, states, events, signals, health, losses."
    assert f"  report   {report}\n" in reported
    refused = called("probe", capture_output=True)
    assert refused.returncode == 2
    assert refused.stderr.startswith("Error: Missing argument 'device'. Kind or role: lidar, drive, ")
    assert refused.stderr.endswith(" Try 'python -m monstertruckd probe -h'.\n")


def test_help_is_framed_on_a_terminal():
    reader, terminal = pty.openpty()
    try:
        assert called("log", "--help", stdin=terminal, stdout=terminal, stderr=terminal).returncode == 0
        assert "╭" in os.read(reader, 1 << 16).decode()
    finally:
        os.close(reader)
        os.close(terminal)


@pytest.mark.parametrize("columns", [70, 160])
def test_help_has_the_width_of_the_terminal_it_stands_on(columns: int):
    reader, terminal = pty.openpty()
    try:
        fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
        bare = {name: value for name, value in os.environ.items() if name not in {"COLUMNS", "LINES"}}
        called("log", "--help", env=bare, stdin=terminal, stdout=terminal, stderr=subprocess.PIPE)
        lines = os.read(reader, 1 << 16).decode().splitlines()
        assert max(map(len, lines)) <= columns
        assert any(line.endswith("the original is renamed to LOG.damaged.") for line in lines) is (columns > 100)
        assert lines[0].isascii()
    finally:
        os.close(reader)
        os.close(terminal)


def test_nothing_is_lost_without_a_standard_output(tmp_path: Path):
    (tmp_path / "cut.mcap").write_bytes((ROOT / "tests/data/replay/level.mcap").read_bytes()[:-9])
    command = f"exec {sys.executable} -m monstertruckd log recover {tmp_path}/cut.mcap >&-"
    done = subprocess.run(["sh", "-c", command], cwd=ROOT, capture_output=True, text=True, timeout=30, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    (log,) = list_logs(tmp_path)
    assert log.state is LogState.FINISHED


def test_remarks_never_stand_among_results():
    command = f"exec {sys.executable} -m monstertruckd log info --json nowhere.mcap 2>&-"
    done = subprocess.run(["sh", "-c", command], cwd=ROOT, capture_output=True, text=True, timeout=30, check=False)
    assert (done.returncode, done.stdout) == (Reason.NOT_FOUND.exit_code, "")


def test_a_closed_stream_leaves_its_number_to_no_file():
    """Libuv aborts if a socket of the event loop gets the number of a standard stream."""
    code = "import os; from monstertruckd import __main__ as m; m._occupy_standard_streams(); os._exit(os.dup(0))"
    done = subprocess.run(["sh", "-c", f'exec {sys.executable} -c "{code}" <&- >&- 2>&-'], cwd=ROOT, check=False)
    assert done.returncode == 3


@pytest.mark.parametrize("words", [[], ["status"], ["log"], ["log", "list"], ["goto"]])
def test_h_is_help_everywhere(words: list[str], capsys: pytest.CaptureFixture[str]):
    texts = []
    for option in ("-h", "--help"):
        with pytest.raises(SystemExit) as ended:
            app([*words, option])
        assert not ended.value.code
        texts.append(capsys.readouterr().out)
    assert texts[0] == texts[1]
    assert "Usage" in texts[0]


def test_every_group_has_the_same_help():
    def styles(command: Any) -> Iterator[str | None]:
        yield command.rich_markup_mode
        for inner in getattr(command, "commands", {}).values():
            yield from styles(inner)

    assert set(styles(typer.main.get_command(app))) == {HELP_STYLE}


def test_finish_is_silent_about_success_only(capsys: pytest.CaptureFixture[str]):
    finish(Reason.GOAL_REACHED)
    with pytest.raises(typer.Exit) as ended:
        finish(Reason.PATH_LOST)
    assert ended.value.exit_code == Reason.PATH_LOST.exit_code
    assert capsys.readouterr().err == f"{Reason.PATH_LOST.text}\n"


@pytest.mark.parametrize(
    ("reason", "text", "words"),
    [
        (Reason.DISARMED, "", "the robot is disarmed; `monstertruckd arm` lets it drive\n"),
        (
            Reason.DISARMED,
            "it stands: `monstertruckd arm` lets it drive",
            "it stands: `monstertruckd arm` lets it drive\n",
        ),
        (Reason.ESTOPPED, "stopped 2 s ago", "stopped 2 s ago; `monstertruckd reset` clears the emergency stop\n"),
    ],
)
def test_a_refusal_names_the_command_that_removes_its_cause(
    capsys: pytest.CaptureFixture[str], reason: Reason, text: str, words: str
):
    with pytest.raises(typer.Exit):
        finish(reason, text)
    assert capsys.readouterr().err == words


def test_json_is_strict_whatever_it_is_made_of(capsys: pytest.CaptureFixture[str]):
    print_json({"pose": Pose2D(x=1.0, y=2.0, yaw=0.5), "far": (float("inf"), 1.5), "why": Reason.OK, "at": Path("a/b")})
    shown = json.loads(capsys.readouterr().out)
    assert shown == {"pose": {"x": 1.0, "y": 2.0, "yaw": 0.5}, "far": [None, 1.5], "why": "ok", "at": "a/b"}
    print_json([1, 2], indent=None)
    assert capsys.readouterr().out == "[1, 2]\n"


def test_a_piped_table_is_a_line_for_each_row_whatever_its_width(capsys: pytest.CaptureFixture[str]):
    print_table(("name", "Hz", "what"), [("a", "5", "word " * 60), ("long", "12.5", "")], right=("Hz",), title="seen")
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "name    Hz  what"
    assert lines[1].startswith("a        5  word word")
    assert lines[2] == "long  12.5"
    assert not any(line.endswith(" ") for line in lines)


@pytest.fixture
def narrow(monkeypatch: pytest.MonkeyPatch) -> None:
    """A terminal of 40 columns."""
    monkeypatch.setattr("monstertruckd.tools.cli.output.on_terminal", lambda _: True)
    monkeypatch.setattr("monstertruckd.tools.cli.calibrate.on_terminal", lambda _: True)
    monkeypatch.setenv("COLUMNS", "40")


@pytest.mark.usefixtures("narrow")
def test_a_path_is_whole_on_a_terminal_too(capsys: pytest.CaptureFixture[str]):
    path = "runs/demo/logs/blackbox/blackbox-000001-drive_stale.mcap"
    print_table(("MB", "log"), [("0.4", path)])
    assert capsys.readouterr().out.splitlines() == ["MB", "  log", "0.4", f"  {path}"]
    print_table(("MB", "log"), [("0.4", "runs/a.mcap")])
    assert len(capsys.readouterr().out.splitlines()) == 2, "a short one stands in its row"


@pytest.mark.usefixtures("narrow")
def test_words_that_have_no_room_beside_the_row_stand_below_it(capsys: pytest.CaptureFixture[str]):
    meaning = "stopping distance at full speed, counted from the bumper"
    print_table(("setting", "bounds", "meaning"), [("gate.margin_of_all", "> 0, <= 0.5", meaning)], right=("bounds",))
    assert capsys.readouterr().out.splitlines()[2:] == [
        "gate.margin_of_all  > 0, <= 0.5",
        "  stopping distance at full speed,",
        "  counted from the bumper",
    ]
    print_table(("key", "meaning"), [("gate", meaning)])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3, "room enough: a table"
    assert not set(" ".join(lines[1:]).split()) - {"gate", *meaning.split()}, "no word is broken"


@pytest.mark.usefixtures("narrow")
def test_what_a_calibrated_value_means_is_whole_on_a_terminal(capsys: pytest.CaptureFixture[str]):
    meaning = "scale of the voltage: what the controller tells times this is what the meter shows"
    estimate = Estimate(name="gain", value=1.25, unit="1", samples=4, date="2026-11-22T12:00:00Z", meaning=meaning)
    _print(Result(wizard="battery", measured="test", estimates=(estimate,)))
    lines = capsys.readouterr().out.splitlines()
    assert " ".join(map(str.strip, lines[1:])) == f"{meaning}; 4 samples, 2026-11-22 12:00"
    assert max(map(len, lines)) <= 40


def test_progress_is_silent_where_nobody_looks(capsys: pytest.CaptureFixture[str]):
    with progress("reading", total=10) as done:
        done(5)
    assert capsys.readouterr() == ("", "")


def test_a_terminal_breaks_no_word_of_a_remark(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setenv("COLUMNS", "30")
    text = "/a/path/that/is/longer/than/the/terminal: cannot be read, and that is why\n  indented"
    remark(text)
    assert capsys.readouterr().err == text + "\n", "a pipe gets the line whole"
    monkeypatch.setattr("monstertruckd.tools.cli.output.on_terminal", lambda _: True)
    remark(text)
    assert capsys.readouterr().err.splitlines() == [
        "/a/path/that/is/longer/than/the/terminal:",
        "cannot be read, and that is",
        "why",
        "  indented",
    ]


def test_a_value_without_a_unit_is_followed_by_its_grade(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr("monstertruckd.tools.cli.calibrate.on_terminal", lambda _: True)
    estimate = Estimate(
        name="gain", value=1.25, unit="", samples=4, date="2026-11-22T12:00:00Z", meaning="m", grade="A"
    )
    _print(Result(wizard="battery", measured="", estimates=(estimate, estimate.model_copy(update={"unit": "V"}))))
    assert capsys.readouterr().out.splitlines()[::2] == ["battery.gain: 1.25, A", "battery.gain: 1.25 V, A"]


def test_an_end_says_its_reason_once_and_breaks_no_word(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    reason = Reason.OBSTACLE_STOP
    with pytest.raises(typer.Exit):
        print_end(reason, f"the gate does not let it drive: {reason.text}", {}, json_output=False)
    assert capsys.readouterr().err == f"the gate does not let it drive: {reason.text}\n"
    monkeypatch.setattr("monstertruckd.tools.cli.output.on_terminal", lambda _: True)
    monkeypatch.setenv("COLUMNS", "40")
    print_end(Reason.BEHAVIOUR_DONE, "turned 1.563 rad", {}, json_output=False)
    assert capsys.readouterr().out == "a behaviour is complete: turned 1.563\nrad (89.6°)\n"


def test_the_end_of_a_drive_says_angles_in_degrees_too(capsys: pytest.CaptureFixture[str]):
    text = "0.012 m and 0.031 rad away, at 0.500 rad/s"
    print_end(Reason.GOAL_REACHED, text, {}, json_output=False)
    assert capsys.readouterr().out.endswith("0.012 m and 0.031 rad (1.8°) away, at 0.500 rad/s\n")
    with pytest.raises(typer.Exit):
        print_end(Reason.GOAL_MISSED, text, {}, json_output=False)
    assert "0.031 rad (1.8°) away" in capsys.readouterr().err


def test_lines_of_progress_break_no_word_on_a_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    line = "  155 s  standing: no fresh drive feedback"
    print_words(line)
    assert capsys.readouterr().out == f"{line}\n"
    monkeypatch.setattr("monstertruckd.tools.cli.output.on_terminal", lambda _: True)
    monkeypatch.setenv("COLUMNS", "36")
    print_words(line)
    assert capsys.readouterr().out == "  155 s  standing: no fresh drive\nfeedback\n"


def test_answers_of_emulated_robots_break_no_word_on_a_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    async def serve(clock, configs, say, *_) -> int:
        devices = ("lidar", "drive", "steering", "compass", "stabiliser")
        FaultConsole(CommandedGroup("device", dict.fromkeys(devices)), sys.stdin, say).execute("wheel")
        return 0

    monkeypatch.setattr("monstertruckd.tools.simulation.simulate.serve", serve)
    monkeypatch.setattr("monstertruckd.tools.cli.output.on_terminal", lambda _: True)
    monkeypatch.setenv("COLUMNS", "40")
    assert CliRunner().invoke(app, ["simulate"]).output.splitlines() == [
        "error: start the line with a device:",
        "lidar, drive, steering, compass,",
        "stabiliser; `lidar help` lists its",
        "commands",
    ]
