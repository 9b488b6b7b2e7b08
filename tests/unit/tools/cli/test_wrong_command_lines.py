"""Command lines that somebody gets wrong: one sentence and the reason's exit code."""

import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.core import TyperGroup
from typer.main import get_command

from monstertruckd.tools.cli.main import app
from monstertruckd.tools.cli.output import NumberCommand

ROOT = Path(__file__).resolve().parents[4]

WRONG = (
    ("track /nonexistent.csv", 3, "/nonexistent.csv: cannot be read: No such file or directory"),
    (
        "calibrate camera --square 30 --marker 40",
        3,
        "--marker 40: expected less than --square 30, the square around the marker",
    ),
    ("track configs/truck.yaml", 3, "configs/truck.yaml: expected a mapping with waypoints, or with the poses of"),
    ("statu", 2, "Error: No such command 'statu'. Did you mean 'status', 'station', 'study'? Try '"),
    (
        "arm -e nonsense",
        3,
        "--endpoint 'nonsense': expected tcp/HOST:PORT or tls/HOST:PORT, such as tcp/127.0.0.1:7447",
    ),
    ("status --once -e tcp/127.0.0.1", 3, "--endpoint 'tcp/127.0.0.1': expected tcp/HOST:PORT"),
    ("estop -e tcp:127.0.0.1:7447", 3, "--endpoint 'tcp:127.0.0.1:7447': expected tcp/HOST:PORT"),
    ("--nope", 2, "Error: No such option: --nope"),
    ("status extra", 2, "Error: Got unexpected extra argument(s) (extra)"),
    ("status --robot", 2, "Error: Option '--robot' requires an argument."),
    ("echo", 2, "Error: Missing argument 'topic'."),
    ("echo no/topic", 4, "no topic no/topic; `monstertruckd topics` lists all"),
    ("echo pose", 4, "no topic pose (did you mean state/pose, stand/pose?); `monstertruckd topics` lists all"),
    ("echo state/odometri", 4, "no topic state/odometri (did you mean state/odometry"),
    ("run", 2, "Error: Missing option '--config' / '-c'."),
    ("run -c", 2, "Error: Option '-c' requires an argument."),
    ("run -c /nonexistent.yaml", 2, "/nonexistent.yaml: cannot be read: No such file or directory"),
    (
        "run -c configs/goal.yaml",
        2,
        "configs/goal.yaml: cannot be read: No such file or directory (did you mean configs/goals.yaml?)",
    ),
    ("simulate -c goals.yaml", 2, "goals.yaml: cannot be read: No such file or directory (did you mean configs/goals"),
    ("run -c .", 2, ".: cannot be read: Is a directory"),
    ("run -c /dev/null", 2, "/dev/null: cannot be read: Not a regular file"),
    ("simulate --config", 2, "Error: Option '--config' requires an argument."),
    ("simulate -c /nonexistent.yaml", 2, "/nonexistent.yaml: cannot be read: No such file or directory"),
    (
        "simulate -c configs/truck.yaml",
        2,
        "configs/truck.yaml: describes a real robot: add a section `sim`, as in the b",
    ),
    ("simulate --robots configs/demo.yaml,", 3, "--robots configs/demo.yaml,: expected file names separated by commas"),
    ("set gate.speed nan", 3, "gate.speed nan: expected a finite number"),
    ("set gate.speed -- -inf", 3, "gate.speed -inf: expected a finite number"),
    ("set gate.speed 1e999", 3, "gate.speed 1e999: expected a finite number"),
    (
        "demo --fast -c configs/goals.yaml",
        2,
        "configs/goals.yaml: path: expected a path to drive, or an explorer; `monstert",
    ),
    ("demo --seed x", 2, "Error: Invalid value for '--seed': expected a whole number"),
    ("demo --seed -1 --fast -c /nonexistent", 2, "/nonexistent: cannot be read: No such file or directory"),
    (
        "demo -c configs/truck.yaml --fast",
        2,
        "configs/truck.yaml: describes a real robot: add a section `sim`, as in the b",
    ),
    ("drill --nope", 2, "Error: No such option: --nope"),
    ("drill x y", 2, "Error: Got unexpected extra argument(s) (x y)"),
    ("bogus", 2, "Error: No such command 'bogus'."),
    ("arm --hold now", 2, "Error: Got unexpected extra argument(s) (now)"),
    ("disarm --fast", 2, "Error: No such option: --fast"),
    ("estop now", 2, "Error: Got unexpected extra argument(s) (now)"),
    ("reset now", 2, "Error: Got unexpected extra argument(s) (now)"),
    ("echo sensor/scan extra", 2, "Error: Got unexpected extra argument(s) (extra)"),
    ("log list --nope", 2, "Error: No such option: --nope"),
    (
        "map show README.md",
        3,
        "README.md: not a map: expected the folder of a saved map, or a map_server YAML (README.md:6",
    ),
    (
        "map show configs/goals.yaml",
        3,
        "configs/goals.yaml: not a map: expected the folder of a saved map, or a map_server",
    ),
    (
        "config show",
        2,
        "Error: Missing argument 'config'. Configuration: a file (YAML), or the name of a bun",
    ),
    ("map show", 2, "Error: Missing argument 'place'."),
    ("map localise", 2, "Error: Missing argument 'log'."),
    ("config show configs/truck.yaml extra", 2, "Error: Got unexpected extra argument(s) (extra)"),
    ("plan configs/truck.yaml 0,0,0 1,1,0", 3, "configs/truck.yaml: not a map: expected the folder of"),
    ("log animate", 2, "Error: Missing argument 'log'."),
    ("log recover /nonexistent", 4, "/nonexistent: no such log"),
    ("log view /nonexistent", 4, "/nonexistent: no such log"),
    ("replay /nonexistent --rate x", 2, "Error: No such option: --rate (Possible options: --robot)"),
    ("arm now", 2, "Error: Got unexpected extra argument(s) (now)"),
    ("reset -r", 2, "Error: Option '-r' requires an argument."),
    ("plan", 2, "Error: Missing argument 'MAP'."),
    ("plan /nonexistent.yaml 0,0,0 1,1,0", 3, "/nonexistent.yaml: cannot be read: No such file or directory"),
    ("plan configs/worlds/rooms.yaml 0,0 1,1,0", 3, "pose '0,0': expected x,y,yaw, m and degrees"),
    ("plan configs/worlds/rooms.yaml a,b,c 1,1,0", 3, "pose 'a,b,c': expected x,y,yaw, m and degrees"),
    (
        "plan configs/worlds/rooms.yaml 1.5,2,0 9,5.5,nan",
        48,
        "request contains NaN or infinity: start and goal: expected finite numbers",
    ),
    (
        "plan configs/worlds/rooms.yaml 1.5,2,0 900,5.5,0",
        32,
        "the goal is off the map: goal (900, 5.5, 0): outside the",
    ),
    (
        "plan configs/worlds/rooms.yaml 1.5,2,0 9,5.5,0 --planner nope",
        3,
        "monstertruck.route_planners: no kind 'nope': expected one of",
    ),
    (
        "plan configs/worlds/rooms.yaml 1.5,2,0 9,5.5,0 --steering 6ws",
        2,
        "Error: Invalid value for '--steering': '6ws' is not one of '2ws",
    ),
    ("goto", 2, "Error: Missing argument 'x'."),
    ("goto 1 2", 2, "Error: Missing argument 'yaw'."),
    ("goto a b c", 2, "Error: Invalid value for 'x': expected a number. Try '"),
    ("goto 1 2 x", 2, "Error: Invalid value for 'yaw': expected degrees, or radians such as 1.57rad"),
    ("goto 3 4 361", 3, "heading 361: expected at most one turn, 360 degrees or 6.283rad"),
    ("goto 3 4 90rad", 3, "heading 90rad: expected at most one turn, 360 degrees or 6.283rad"),
    ("goto 3 4 0 --via 1,2,-400deg", 3, "heading -400deg: expected at most one turn"),
    ("goto 1 2 3 --via 1", 3, "pose '1': expected x,y or x,y,yaw, m and degrees"),
    ("goto nan 2 3", 2, "Error: Invalid value for 'x': expected a number, not nan"),
    ("goto 1 -inf 3", 3, "pose 1,-inf,3: expected finite numbers, m and degrees"),
    ("goto 1 2 3 --via 1,nan", 3, "pose 1,nan: expected finite numbers, m and degrees"),
    ("points mark dock 1 1e999", 3, "pose 1,inf: expected finite numbers, m and degrees"),
    ("points goto dock --distance nan", 2, "Error: Invalid value for '--distance': "),
    ("emulate lidar --seed -1", 2, "Error: Invalid value for '--seed': expected greater than or equal to 0"),
    ("study circle --ratio 0", 3, "--ratio: expected greater than 1"),
    ("study circle --laps inf", 3, "--laps: expected a finite number"),
    ("study straight --passes 0", 3, "--passes: expected greater than or equal to 1"),
    ("study straight --reference -1", 3, "--reference: expected greater than 0"),
    ("kinematics radius-table --limit nan", 2, "Error: Invalid value for '--limit' / '-l': expected a number"),
    ("map build x.npz --mount 0 nan 0", 2, "Error: Invalid value for '--mount': expected a number, not nan"),
    ("replay", 2, "Error: Missing argument 'log'."),
    ("replay /nonexistent.mcap", 4, "/nonexistent.mcap: no such log"),
    ("replay configs/truck.yaml", 3, "configs/truck.yaml: not an MCAP log"),
    ("emulate", 2, "Error: Missing argument 'device'."),
    ("emulate lidar --link", 2, "Error: Option '--link' requires an argument."),
    ("emulate lidar -l /proc/foo", 3, "/proc/foo: No such file or directory"),
    ("probe", 2, "Error: Missing argument 'device'."),
    ("probe nothing", 3, "unknown"),
    ("probe lidar", 3, "lidar: pass its port with --port"),
    ("probe lidar -p /nonexistent", 20, "/nonexistent: not plugged in"),
    ("probe lidar -p /dev/null", 20, "/dev/null: no serial port"),
    ("probe lidar -p /tmp", 20, "/tmp: Is a directory"),
    (
        "probe lidar -p /dev/null --baud x",
        2,
        "Error: Invalid value for '--baud': expected a whole number",
    ),
    ("probe host -p /dev/null", 3, "host: is part of the computer and has no port; omit --port"),
    ("find-port", 2, "Error: Missing argument 'role'."),
    ("find-port nope", 3, "no role 'nope'; known"),
    ("find-port lidar --write /nonexistent.yaml", 3, "/nonexistent.yaml: cannot be read: No such file or directory"),
    ("find-port lidar --write README.md", 3, "README.md:6: not valid YAML: mapping values are not allowed here"),
    ("doctor x", 2, "Error: Got unexpected extra argument(s) (x)"),
    ("config nope", 2, "Error: No such command 'nope'."),
    ("config show", 2, "Error: Missing argument 'config'."),
    ("config show /nonexistent.yaml", 2, "/nonexistent.yaml: cannot be read: No such file or directory"),
    ("config show configs/truck.yaml --key no.such.key", 4, "configs/truck.yaml: no settings at no.such.key; sect"),
    ("config show README.md", 2, "README.md:6: not valid YAML: mapping values are not allowed here"),
    (
        "config show configs/paths/loop.csv",
        2,
        "configs/paths/loop.csv:1: expected a mapping of sections, found a plain valu",
    ),
    ("config migrate /nonexistent.yaml", 2, "/nonexistent.yaml: cannot be read: No such file or directory"),
    ("config migrate README.md", 2, "README.md:6: not valid YAML: mapping values are not allowed here"),
    ("calibrate nope", 2, "Error: No such command 'nope'."),
    ("log nope", 2, "Error: No such command 'nope'."),
    ("log list /nonexistent", 4, "/nonexistent: no such folder"),
    ("log list README.md", 4, "README.md: no such folder"),
    ("log info", 2, "Error: Missing argument 'log'."),
    ("log info /nonexistent", 4, "/nonexistent: no such log"),
    ("log info README.md", 3, "README.md: not an MCAP log"),
    ("log info .", 3, ".: a folder; `monstertruckd log list .` lists the logs in it"),
    ("log recover README.md", 3, "README.md: not an MCAP log"),
    ("log report README.md", 3, "README.md: not an MCAP log"),
    ("log report /nonexistent", 4, "/nonexistent: no such log"),
    ("log view README.md", 3, "README.md: not an MCAP log"),
    ("log export README.md", 2, "Error: Missing argument 'output'."),
    (
        "log export README.md --format nope",
        2,
        "Error: Invalid value for '--format' / '-f': 'nope' is not one of 'csv'",
    ),
    ("log report docs", 3, "docs: a folder; `monstertruckd log list docs` lists the logs in it"),
    (
        "mission check configs/demo.yaml",
        2,
        "configs/demo.yaml:1: this is another kind of file: expected name, steps",
    ),
    (
        "stand run -c configs/truck.yaml",
        2,
        "configs/truck.yaml:1: this is another kind of file: expected cameras, marks",
    ),
    (
        "run -c configs/stands/overhead.yaml",
        2,
        "configs/stands/overhead.yaml:1: this is another kind of file: expected",
    ),
    ("stand print /nonexistent --tags 5-2", 3, "tags '5-2': expected numbers such as 0-3,100"),
    (
        "map build docs/pictures/lap.png",
        3,
        "docs/pictures/lap.png:1: expected a log with scans (MCAP, bag, npz or text): not UTF-8",
    ),
    ("plan docs 0,0,0 1,1,0", 3, "docs/map.yaml: cannot be read: No such file or directory"),
    ("log animate README.md", 2, "Error: Missing argument 'output'."),
    ("kinematics nope", 2, "Error: No such command 'nope'."),
    ("kinematics radius-table --nope", 2, "Error: No such option: --nope"),
    ("kinematics show /nonexistent", 3, "family '/nonexistent': expected one of"),
    ("map nope", 2, "Error: No such command 'nope'."),
    ("map build /nonexistent.mcap", 4, "/nonexistent.mcap: no such log"),
    ("map show /nonexistent", 3, "/nonexistent: cannot be read: No such file or directory"),
    ("map localise /nonexistent README.md", 3, "README.md: not a map: expected the folder of a saved map"),
    ("security nope", 2, "Error: No such command 'nope'."),
    ("reasons x", 2, "Error: Got unexpected extra argument(s) (x)"),
    ("topics x", 2, "Error: Got unexpected extra argument(s) (x)"),
    ("plugins x", 2, "Error: Got unexpected extra argument(s) (x)"),
    ("study analyse README.md", 3, "README.md: not an MCAP log"),
    ("study analyse /nonexistent", 4, "/nonexistent: no such log"),
)
"""What is typed after ``monstertruckd`` in the project's folder, exit code, beginning of the complaint."""


@pytest.mark.parametrize(("words", "code", "expected"), WRONG, ids=[words for words, *_ in WRONG])
def test_a_wrong_command_line_is_one_clear_line(
    words: str, code: int, expected: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(ROOT)
    with pytest.raises(SystemExit) as ended:
        app(shlex.split(words))
    said = capsys.readouterr()
    (complaint,) = said.err.strip().splitlines()
    assert (ended.value.code, complaint[: len(expected)], said.out) == (code, expected, "")
    assert not complaint.startswith("Error: ") or " Try '" in complaint


def test_every_command_refuses_nan():
    def below(group: TyperGroup) -> Iterator[object]:
        for command in group.commands.values():
            yield from below(command) if isinstance(command, TyperGroup) else [command]

    root = get_command(app)
    assert isinstance(root, TyperGroup)
    assert all(isinstance(command, NumberCommand) for command in below(root))


def test_they_are_sixty_at_least():
    assert len({words for words, *_ in WRONG}) >= 60
