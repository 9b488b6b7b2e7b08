"""The command lines of README, CONTRIBUTING and docs, and how a test runs each."""

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import typer

from monstertruckd.tools.cli.main import app

ROOT = Path(__file__).resolve().parents[3]
PAGES = (
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *(page for page in sorted((ROOT / "docs").rglob("*.md")) if "site" not in page.parent.parts),
)
PROGRAMS = (
    r"(?:[\w./]*/)?(?:monstertruckd|mkdocs|pip|python3?|systemctl|journalctl|pre-commit|lint-imports"
    r"|podman|git|cd|export|ros2|rviz2)"
)
SHELL = re.compile(rf"(?:sudo )?{PROGRAMS} (?=[\w/-])(?:[^ ].*)")
INLINE = re.compile(r"`((?:monstertruckd [^`]+)|(?:(?:python )?benchmarks/[^`]+))`")


@dataclass(frozen=True, slots=True)
class Instead:
    """What is run in place of a line."""

    line: str | None
    """None = it is only looked up: command and options have to be there."""
    why: str
    code: int | None = 0
    """None = any that is the exit code of a reason."""


MOVES = "drives for minutes; tests/daemon/test_calibration_virtual.py does it on the virtual clock"
SYSTEM = "needs root"
OWN_DEVICE = "needs the page's own package; tests/daemon/test_own_device.py installs and runs it"

SHORTENED = ("full3d", "slam")
"""Configurations whose demo drives 0.7 m instead of a lap."""

INSTEAD = {
    "monstertruckd log view logs/run-000001-000.mcap": Instead(
        "monstertruckd log view logs/run-000001-000.mcap --save shown.rrd", "opens a window and stays"
    ),
    **{
        f"monstertruckd demo --fast --config configs/{name}.yaml": Instead(
            f"monstertruckd demo --fast --config short_{name}.yaml", "a shorter path; tests/daemon drives laps"
        )
        for name in SHORTENED
    },
    **{
        f"monstertruckd replay logs/run-000001-000.mcap --check{more}": Instead(
            f"monstertruckd replay logs/run-000001-000.mcap --check{more} --tolerance 1e-6",
            "the recorded log is of another processor, whose maths routines round otherwise",
        )
        for more in ("", " --json")
    },
    "monstertruckd drill --count 3": Instead("monstertruckd drill --count 1", "one fault shows the same"),
    "monstertruckd install-service --config configs/truck.yaml --start": Instead(
        "monstertruckd install-service --config configs/truck.yaml --start --root system --dry-run", SYSTEM
    ),
    "monstertruckd install-service --start": Instead(
        "monstertruckd install-service --start --root system --dry-run", SYSTEM
    ),
    "monstertruckd install-service --upgrade": Instead(None, "needs a service; benchmarks/service.py boots one"),
    "monstertruckd security check --endpoint tls/192.168.1.7:7447": Instead(
        None, "needs a robot with certificates; tests/unit/tools/security/test_security.py checks one"
    ),
    "monstertruckd uninstall-service": Instead("monstertruckd uninstall-service --root system --dry-run", SYSTEM),
    "monstertruckd doctor": Instead("monstertruckd doctor --root system", "looks at this computer", code=None),
    "monstertruckd usb --local": Instead("monstertruckd usb --local", "looks at this computer", code=None),
    "monstertruckd find-port lidar --write configs/truck.yaml": Instead(
        None, "waits for a hand at a cable; tests/daemon/test_usb_wall.py pulls an emulated one"
    ),
    "monstertruckd drive --mapping pad.yaml": Instead(
        None, "needs the file; tests/unit/tools/driving/test_gamepad.py reads mappings"
    ),
    "monstertruckd try": Instead(None, "serves until it is stopped; tests/daemon/test_tryout_wall.py opens its page"),
    "monstertruckd ros2": Instead(None, "serves until it is stopped; tests/unit/ros2/test_face.py runs it"),
    "monstertruckd station --rerun": Instead(None, "serves until it is stopped; test_live.py draws without a viewer"),
    "monstertruckd goto 8.5 6 0 --arm": Instead(
        None, "needs a robot that plans; tests/daemon/test_goals_virtual.py has one"
    ),
    "monstertruckd mission run configs/missions/rooms.yaml --arm": Instead(
        None, "drives for minutes; tests/daemon/test_missions_virtual.py runs one"
    ),
    "monstertruckd behave start line_left --robot sonar --arm": Instead(
        None, "needs the robot with sonars; tests/daemon/test_sonar_robot_virtual.py has it"
    ),
    "monstertruckd map save hall.yaml": Instead(None, "needs a robot that maps"),
    "monstertruckd stand print runs/stand/print --tags 0-3,100-125": Instead(
        "monstertruckd stand print print --tags 0-3", "fewer prints"
    ),
    **{
        f"monstertruckd stand {rest}": Instead(None, "needs cameras; tests/unit/tools/stand renders their pictures")
        for rest in (
            "snap -c configs/stands/overhead.yaml c1 runs/stand/c1/boards",
            "snap -c configs/stands/overhead.yaml c1 runs/stand/c1/floor --count 3",
            "calibrate -c configs/stands/overhead.yaml",
            "run -c configs/stands/overhead.yaml",
            "track -c configs/stands/overhead.yaml --out runs/stand/poses.csv",
        )
    },
    "monstertruckd stand analyse logs/run.mcap": Instead(None, "needs a log of a stand"),
    "monstertruckd calibrate battery": Instead(
        "monstertruckd calibrate battery --yes --answer meter=24.2 --answer another=no", "asks somebody"
    ),
    "monstertruckd calibrate accept": Instead(
        None, "needs a proposal; tests/daemon/test_calibration_wall.py accepts one"
    ),
    "monstertruckd calibrate drive": Instead(None, MOVES),
    "monstertruckd calibrate drive --sign-only": Instead(None, MOVES),
    "monstertruckd calibrate steering": Instead(None, MOVES),
    "monstertruckd calibrate steering --rough": Instead(None, MOVES),
    "monstertruckd calibrate compass": Instead(None, MOVES),
    "monstertruckd calibrate all": Instead("monstertruckd calibrate all --dry-run", "asks somebody, and drives"),
    "monstertruckd calibrate odometry": Instead(None, MOVES),
    "monstertruckd calibrate lidar": Instead(None, MOVES),
    "monstertruckd calibrate imu": Instead(None, MOVES),
    "monstertruckd calibrate slip": Instead(None, MOVES),
    "monstertruckd calibrate sonar": Instead(None, MOVES),
    "monstertruckd calibrate stabiliser": Instead(None, "asks somebody who lifts the truck"),
    "monstertruckd calibrate camera": Instead(
        None, "needs a board held before a camera: tests/daemon/test_calibration_mounts_virtual.py"
    ),
    "monstertruckd explore --arm --robot turtle": Instead(
        None, "drives for minutes; tests/daemon/test_explore_virtual.py explores"
    ),
    "monstertruckd config show robot.yaml": Instead(
        None, "needs the page's own package; tests/daemon/test_own_check.py installs it"
    ),
    "monstertruckd demo --fast -c robot.yaml": Instead(None, OWN_DEVICE),
    "monstertruckd emulate ranger --link /tmp/ranger": Instead(None, OWN_DEVICE),
    "monstertruckd probe ranger --port /tmp/ranger": Instead(None, OWN_DEVICE),
}
SERVING = (
    "monstertruckd station --robot truck@tcp/127.0.0.1:7447",
    "monstertruckd station --robot ann@tcp/192.168.1.7:7447 --robot bob@tcp/192.168.1.8:7447",
    "monstertruckd station --router tcp/192.168.1.2:7447",
    "monstertruckd station --host 0.0.0.0 --certificate station.pem --key station.key --users users.yaml "
    "--name station.local",
    "monstertruckd station --foxglove",
)
"""Lines that serve until they are stopped; test_docs_wall.py starts each."""
FIRST_DAY = "tests/daemon/test_first_day_virtual.py runs it on the twin"
DEVICES = ("drive", "steering", "compass", "stabiliser", "camera")
INSTEAD |= {
    f"monstertruckd {line}": Instead(None, FIRST_DAY)
    for line in (
        *(f"find-port {role} --write configs/truck.yaml" for role in DEVICES),
        "explore --arm --find 3 --home",
        "points list",
        "points goto tag-1 --arm",
        "points export tags.csv",
        "goto 0 0 0 --arm",
        "map save first.yaml",
    )
}
INSTEAD |= {
    f"monstertruckd study {run}": Instead(None, "drives for minutes; tests/daemon/test_study_virtual.py does it")
    for run in (
        "circle --ratio 2 --reference 1.57",
        "circle --ratio 3 --reference 1.25",
        "circle --ratio inf --reference 1.57",
        "straight --length 0.682 --passes 12",
        "analyse logs/run-000001-000.mcap --out figures",
    )
}
FOREIGN = {
    "python3 -m monstertruckd.bootstrap demo": "sets up .venv, then `monstertruckd demo`, which has its own tests",
    "python3 -m monstertruckd.bootstrap demo --config lap": "the same",
    "python3 -m monstertruckd.bootstrap try": "sets up .venv, then `monstertruckd try`, which has its own tests",
    "python3 -m monstertruckd.bootstrap check": "runs this very test",
    "python3 systemd/debian/build.py": "benchmarks/package.py builds the package and installs it in a Debian",
    "python3 -m monstertruckd.bootstrap sync": "sets up .venv; tests/unit/test_bootstrap.py checks what it runs",
    "python3 systemd/supervise.py .venv/bin/monstertruckd run --config configs/truck_emulated.yaml": (
        "tests/unit/systemd/test_supervise.py supervises other programs"
    ),
    "python docs/site/build.py": "test_site.py builds it into another folder",
    "python benchmarks/record.py deaths --measures monstertruckd/gate systemd/neutral.py -- benchmarks/deaths.py": (
        "runs for minutes; test_figures.py checks what it writes"
    ),
    "python -m benchmarks.thesis --only 5.1 5.5": "drives for minutes; slowness and scores have their tests",
    **dict.fromkeys(
        (
            "python -m hatchling build -t wheel -d dist",
            *(
                f"python -m zipfile -e dist/truck_{name}-1.0-py3-none-any.whl plugins"
                for name in ("sonar", "bumper", "linear", "tracked")
            ),
        ),
        "test_writing_pages.py runs it in the page's own package",
    ),
    "pip install '.[ros2]'": "needs a package index; the extra is looked up",
    "pip install '.[tables,plot]'": "needs a package index; the extra is looked up",
    "pip install '.[view]'": "needs a package index; the extra is looked up",
    "systemctl status monstertruckd": "needs an installed service; the unit's name is looked up",
    "journalctl -u monstertruckd -f": "needs an installed service; the unit's name is looked up",
    "export PYTHONPATH=$PWD/plugins": "test_writing_pages.py runs it in the page's own package",
    **dict.fromkeys(
        (
            "podman build --tag monstertruckd --file systemd/container/Dockerfile .",
            "podman run --rm --network host monstertruckd",
            "podman run --rm --network host monstertruckd status",
            "podman run --network host --device /dev/ttyACM0 --device /dev/ttyUSB0 --group-add keep-groups "
            "--volume ./configs:/etc/monstertruckd:ro --volume truck:/var/lib/monstertruckd "
            "--entrypoint python3 monstertruckd /opt/monstertruckd/systemd/supervise.py "
            "monstertruckd run --config /etc/monstertruckd/truck.yaml "
            "-- python3 /opt/monstertruckd/systemd/neutral.py /dev/ttyUSB0",
        ),
        "needs podman; benchmarks/container.py builds and runs the image; its files and commands are looked up",
    ),
    **dict.fromkeys(
        (
            "export RMW_IMPLEMENTATION=rmw_zenoh_cpp "
            """ZENOH_CONFIG_OVERRIDE='connect/endpoints=["tcp/127.0.0.1:7448"]'""",
            "ros2 daemon stop",
            "ros2 topic list",
            "rviz2 -d robot.rviz",
            "ros2 run foxglove_bridge foxglove_bridge",
            "ros2 bag record /scan /odom /tf /tf_static /map",
            "ros2 service call /truck/arm std_srvs/srv/Trigger",
            "ros2 run teleop_twist_keyboard teleop_twist_keyboard --ros-args -p speed:=0.2",
            "ros2 action send_goal -f /navigate_to_pose nav2_msgs/action/NavigateToPose "
            '"{pose: {header: {frame_id: map}, pose: {position: {x: 1.0}, orientation: {w: 1.0}}}}"',
            "ros2 launch nav2_bringup navigation_launch.py",
            "ros2 service call /truck/estop std_srvs/srv/Trigger",
        ),
        "needs ROS 2, which the page lists as not tried; tests/daemon/test_ros2_wall.py calls the same interfaces",
    ),
    "git -C /opt/monstertruckd worktree add /opt/monstertruckd_2 v2": "needs an installed service",
    "cd /opt/monstertruckd_2 && python3 -m monstertruckd.bootstrap sync": "the same",
}
"""Lines that are no command of ours: why they are not run."""


@dataclass(frozen=True, slots=True)
class Line:
    """One command line of a page, without ``sudo``, folders of programs, and comments."""

    place: str
    text: str

    @property
    def arguments(self) -> list[str]:
        return shlex.split(self.text)[1:]


@cache
def lines() -> tuple[Line, ...]:
    """Every command line in a code block, each once."""
    found: dict[str, Line] = {}
    for page in PAGES:
        for line in lines_of(page):
            found.setdefault(line.text, line)
    return tuple(found.values())


def lines_of(page: Path) -> list[Line]:
    """The command lines in the code blocks of one page, in their order."""
    found = []
    for number, text in _code(page.read_text(encoding="utf-8")):
        if SHELL.fullmatch(text):
            plain = re.sub(rf"^(?:sudo )?({PROGRAMS})", lambda m: Path(m[1]).name, text.partition("  #")[0].strip())
            found.append(Line(f"{page.relative_to(ROOT)}:{number}", plain))
    return found


def _code(text: str) -> Iterator[tuple[int, str]]:
    """Numbered lines of indented blocks and of blocks between fences; those that end in a backslash go on."""
    fenced, begun = False, ""
    for number, line in enumerate(text.splitlines(), 1):
        if line.startswith("```"):
            fenced = not fenced
        elif fenced or line.startswith("    "):
            begun += line.strip()
            if begun.endswith("\\"):
                begun = begun.removesuffix("\\")
            else:
                yield number, begun
                begun = ""


def inline() -> list[tuple[str, str]]:
    """Every command named within a sentence, with its page."""
    return [
        (page.name, found)
        for page in PAGES
        if page.name != "CHANGELOG.md"
        for found in INLINE.findall(page.read_text(encoding="utf-8"))
    ]


def is_ours(line: Line) -> bool:
    """Whether it begins with our own command."""
    return line.text.startswith("monstertruckd ")


def ours() -> list[Line]:
    """Lines that begin with our own command."""
    return list(filter(is_ours, lines()))


def needs_truck(line: Line) -> bool:
    """Whether a running daemon has to answer."""
    command, _ = resolve(line.arguments)
    if command.name == "doctor":
        return "--drive" in line.arguments
    return "--endpoint" in options_of(command) and command.name != "replay"


def starts_truck(line: Line) -> bool:
    """Whether it is one of the two processes of an emulated truck."""
    return line.arguments[0] in {"run", "simulate"}


@cache
def _root() -> Any:
    return typer.main.get_command(app)


def resolve(words: list[str]) -> tuple[Any, list[str]]:
    """Command, and the words behind its name.

    Raises:
        LookupError: no such command.
    """
    command = _root()
    rest = list(words)
    while hasattr(command, "commands"):
        if not rest or rest[0] not in command.commands:
            raise LookupError(f"no command {' '.join(words)}")
        command = command.commands[rest.pop(0)]
    return command, rest


def options_of(command: Any) -> set[str]:
    return {flag for parameter in command.params for flag in (*parameter.opts, *parameter.secondary_opts)} | {"--help"}


def commands_of(group: Any) -> list[tuple[str, ...]]:
    """Names of all commands that are shown."""

    def walk(command: Any, name: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
        if not hasattr(command, "commands"):
            if not command.hidden:
                yield name
            return
        for word, inner in command.commands.items():
            yield from walk(inner, (*name, word))

    return list(walk(typer.main.get_command(group), ()))
