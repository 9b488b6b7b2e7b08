"""``mission check|list|run``: mistakes by line, lists, and what is run."""

import asyncio
from pathlib import Path

import pytest
from typer.testing import CliRunner

from monstertruck_runtime.mailbox import Mailbox, fifo, latest
from monstertruck_schemas.plan import MissionState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import GateMode, GateState
from monstertruck_schemas.topics import GATE, MISSION
from monstertruckd.tools.cli.main import app
from monstertruckd.tools.cli.runs import run_mission

CONFIGS = Path(__file__).resolve().parents[4] / "configs"
GOOD = """version: 2
name: round
steps:
  - { do: goto, x: 1, y: 2, yaw: 0, via: [[0, 1]], on_failure: continue }
  - { do: return, retries: 2, limit: 30 }
"""
BAD = GOOD + "  - { do: fly }\n  - { do: wait, seconds: -1 }\n"


def test_check_prints_the_steps_and_their_policies(tmp_path: Path):
    file = tmp_path / "round.yaml"
    file.write_text(GOOD)
    done = CliRunner().invoke(app, ["mission", "check", str(file)])
    assert done.exit_code == 0, done.output
    _, first, second = done.stdout.splitlines()
    assert first.split() == ["1", "0", "-", "continue", "goto", "1", "2", "0", "via", "0,1"]
    assert second.split() == ["2", "2", "30", "abort", "return"]


def test_mistakes_are_named_by_line(tmp_path: Path):
    file = tmp_path / "bad.yaml"
    file.write_text(BAD)
    done = CliRunner().invoke(app, ["mission", "check", str(file)])
    assert done.exit_code == Reason.BAD_CONFIG.exit_code
    assert "bad.yaml:6: steps.2" in done.output
    assert "bad.yaml:7: steps.3.seconds" in done.output


def test_steps_that_are_all_wrong_are_not_called_missing(tmp_path: Path):
    file = tmp_path / "bad.yaml"
    file.write_text("version: 2\nname: round\nsteps:\n  - { do: wait, seconds: -1 }\n")
    said = CliRunner().invoke(app, ["mission", "check", str(file)]).stderr
    assert said == f"{file}:4: steps.0.seconds: input should be greater than 0, found -1\n"
    file.write_text("version: 2\nname: round\nsteps: []\n")
    said = CliRunner().invoke(app, ["mission", "check", str(file)]).stderr
    assert said == f"{file}:3: steps: expected at least 1 in number\n"


def test_a_mistake_is_named_once_and_with_what_its_step_takes(tmp_path: Path):
    file = tmp_path / "bad.yaml"
    step = "{ do: behaviour, name: left, settings: { speed: .nan } }"
    file.write_text(f"version: 2\nname: round\nsteps:\n  - {step}\n  - {{ do: wait, seconds: 1, quickly: 1 }}\n")
    done = CliRunner().invoke(app, ["mission", "check", str(file)])
    lines = [line.partition("bad.yaml:")[2] for line in done.output.splitlines() if "bad.yaml:" in line]
    assert [line[:2] for line in lines] == ["4:", "5:"], done.output
    assert lines[0].startswith("4: steps.0.settings.speed: input should be a finite number")
    assert "steps.1.quickly: unknown key; expected one of do, limit, on_failure, retries, seconds" in lines[1]


def test_list_names_missions_and_what_is_wrong(tmp_path: Path):
    (tmp_path / "a.yaml").write_text(GOOD)
    (tmp_path / "b.yaml").write_text(BAD)
    done = CliRunner().invoke(app, ["mission", "list", str(tmp_path)])
    assert done.exit_code == 0
    assert "round" in done.stdout
    _, good, bad = done.stdout.splitlines()
    assert good.split() == ["a.yaml", "round", "2"]
    assert bad.split()[:4] == ["b.yaml", "line", "6:", "steps.2:"], "steps that cannot be read are not counted"
    assert CliRunner().invoke(app, ["mission", "list", str(tmp_path / "no")]).exit_code == Reason.NOT_FOUND.exit_code


@pytest.mark.parametrize("arguments", [[], ["x.yaml", "--resume"]])
def test_run_takes_a_file_or_the_interrupted_one(arguments: list[str]):
    done = CliRunner().invoke(app, ["mission", "run", *arguments])
    assert done.exit_code == Reason.BAD_INPUT.exit_code


def followed(*states: dict[str, object], mode: GateMode = GateMode.DRIVING) -> list[str]:
    """What a client prints of the mission reported so."""
    reports, gate = Mailbox(fifo(64)), Mailbox(latest())

    def gate_says(*more: Reason) -> None:
        why = () if mode.active else (Reason.DISARMED, *more)
        gate.put(GateState(stamp=1, received=1, seq=0, mode=mode, nonce="n", speed_limit=0.0, reasons=why))

    gate_says()

    class Robot:
        def subscribe(self, topic, delivery):
            return {MISSION: reports, GATE: gate}.get(topic) or Mailbox(delivery)

        async def mission(self, *_, **__):
            header = {"stamp": 1, "received": 1, "seq": 0, "frame": "map", "number": 3, "running": True, "attempt": 1}
            for state in (*states, {"running": False, "outcome": Reason.MISSION_DONE}):
                reports.put(MissionState(**{**header, "steps": 2, **state}))
            return {"number": 3}

    lines: list[str] = []

    def report(line: str) -> None:
        lines.append(line)
        gate_says(Reason.DRIVE_STALE)

    asyncio.run(run_mission(Robot(), None, arm=False, report=report))
    return lines


def test_every_step_and_every_failure_is_a_line():
    first, second = {"node": "1", "doing": "goto 1 0 0"}, {"node": "2", "doing": "return", "failures": 1}
    missed = {"failed": "it missed"}
    assert followed(first, first, {**first, **missed, "attempt": 2}, {**second, **missed, "elapsed": 12.0}) == [
        "     0 s  step 1 of 2: goto 1 0 0",
        "     0 s  failed: it missed",
        "     0 s  step 1 of 2: goto 1 0 0, attempt 2",
        "    12 s  failed: it missed",
        "    12 s  step 2 of 2: return",
    ]


def test_what_a_step_waits_for_and_why_the_robot_stands_is_said_once():
    step = {"node": "1", "doing": "goto 1 0 0"}
    starts = {**step, "text": "the planner is starting"}
    assert followed(starts, starts, step)[1:] == ["     0 s  waiting: the planner is starting"]
    stands = "     0 s  standing: the robot is disarmed; `monstertruckd arm` lets it drive"
    assert followed(starts, step, step, mode=GateMode.DISARMED)[1:] == [stands], "though more becomes stale"


def test_waypoints_of_nav2_are_a_mission(tmp_path: Path):
    file = tmp_path / "way.yaml"
    file.write_text("waypoints:\n  waypoint0: {pose: [1.0, 2.0, 0.0], orientation: [1.0, 0.0, 0.0, 0.0]}\n")
    done = CliRunner().invoke(app, ["mission", "check", str(file)])
    assert done.exit_code == 0, done.output
    assert done.stdout.splitlines()[1].split() == ["1", "0", "-", "abort", "goto", "1", "2", "0"]
    file.write_text("waypoints: [{x: 1}]\n")
    done = CliRunner().invoke(app, ["mission", "check", str(file)])
    assert (done.exit_code, done.stderr) == (3, f"{file}: waypoints 0: expected x and y, position, or pose\n")


BRANCHES = """version: 2
name: patrol
steps:
  - do: repeat
    times: forever
    steps:
      - { do: wait, seconds: 1 }
      - do: fallback
        steps:
          - { do: record, note: here }
          - { do: goto_point, point: dock }
  - { do: return }
"""


def test_steps_that_are_never_reached_are_named_by_line(tmp_path: Path):
    file = tmp_path / "patrol.yaml"
    file.write_text(BRANCHES)
    done = CliRunner().invoke(app, ["mission", "check", str(file)])
    assert done.exit_code == Reason.BAD_CONFIG.exit_code
    assert done.stderr.splitlines() == [
        f"{file}:11: step 1.2.2: is never reached: step 1.2.1 never fails",
        f"{file}:12: step 2: is never reached: step 1 never succeeds",
    ]


def test_what_the_robot_lacks_and_points_that_nobody_knows_are_named_by_line(tmp_path: Path):
    file, saved = tmp_path / "patrol.yaml", tmp_path / "map"
    file.write_text(
        "version: 2\nname: patrol\nsteps:\n  - { do: wait, seconds: 1 }\n"
        "  - do: wait_until\n    when:\n      point: dock\n  - { do: explore }\n"
    )
    done = CliRunner().invoke(app, ["mission", "check", str(file), "--config", str(CONFIGS / "goals.yaml")])
    assert done.exit_code == Reason.BAD_CONFIG.exit_code
    where = [line.partition("patrol.yaml:")[2].split(": ")[:2] for line in done.stderr.splitlines()]
    assert where == [["6", "step 2"], ["8", "step 3"]], done.stderr
    saved.mkdir()
    file.write_text("version: 2\nname: patrol\nsteps:\n  - do: goto_point\n    point: dock\n")
    done = CliRunner().invoke(app, ["mission", "check", str(file), "--map", str(saved)])
    assert (
        done.stderr == f"{file}:5: step 1: point of interest 'dock' is unknown and no step explores: known are none\n"
    )
