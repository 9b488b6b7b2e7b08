"""``monstertruckd try``: emulated robot, daemon with mapping and planner, and operator's page in one command."""

import asyncio
import os
import socket
import sys
import webbrowser
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import ConfigError
from monstertruck_runtime.threads import in_thread
from monstertruck_runtime.yaml_files import yaml_text
from monstertruck_sim.console import Commanded
from monstertruckd.config.load import FILE_VERSION
from monstertruckd.recorder.reader import open_log
from monstertruckd.station.address import RobotAddress
from monstertruckd.station.calibration import Calibrator
from monstertruckd.station.emulated import EmulatedWorld
from monstertruckd.station.server import Place, Station
from monstertruckd.tools.demo.runs import free_endpoint, write_overlay
from monstertruckd.tools.shipped import configuration, shipped
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, load_simulated
from monstertruckd.tools.simulation.simulate import serve

EXPLORING: Final = "configs/parts/exploring.yaml"
PERSON: Final[Mapping[str, Any]] = {"speed": 0.5, "before": "turn"}
"""A person who walks by the seed and turns aside before the robot."""
STEERING: Final = ("4ws", "2ws")
"""Steering modes of routes, best first: not every body supports each."""


def robot_file(name: Path) -> Path:
    """Return the configuration of a robot by name; ``configs/robots`` takes precedence.

    Raises:
        ConfigError: it does not exist.
    """
    own = shipped(f"configs/robots/{name}.yaml")
    return own if len(name.parts) == 1 and own.is_file() else configuration(name)


def write_tryout(robot: Path, folder: Path, endpoint: str) -> tuple[Path, SimulatedTruckConfig]:
    """Write a configuration that adds a person to a simulated robot, and mapping and planner if its body allows them.

    Args:
        robot: configuration of the robot.
        folder: folder for the configuration, logs, state and map.
        endpoint: endpoint of the daemon.

    Raises:
        ConfigError: a real robot, or a mistake in its configuration.
    """
    own = load_simulated(robot)
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "tryout.yaml"
    common = {"version": FILE_VERSION, "path": None, "map": None, "sim": {"world": {"people": [dict(PERSON)]}}}
    *attempts, last = _additions(own, folder)
    for more in attempts:
        file.write_text(yaml_text(_included(robot, more) | common | more), encoding="utf-8")
        with suppress(ConfigError):
            load_simulated(file)
            break
    else:
        file.write_text(yaml_text(_included(robot, last) | common | last), encoding="utf-8")
    overlay = write_overlay(file, folder, endpoint)
    return overlay, load_simulated(overlay)


def _included(robot: Path, more: Mapping[str, Any]) -> dict[str, Any]:
    files = [robot, shipped(EXPLORING)] if "slam" in more else [robot]
    return {"include": [str(file.resolve()) for file in files]}


def _additions(own: SimulatedTruckConfig, folder: Path) -> Iterator[dict[str, Any]]:
    """Yield additions to a robot, most complete first: planner and mapping, mapping alone, nothing."""
    if own.devices.lidar is not None:
        slam = {"slam": {"save": str(folder.resolve() / "explored")}}
        for steering in STEERING:
            yield {"planner": {"steering": steering}, **slam}
        yield {"planner": None, "explorer": None, **slam}
    yield {}


def free_port(wanted: int) -> int:
    """Return the wanted loopback port if it is free, otherwise another free port."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        with suppress(OSError):
            probe.bind(("127.0.0.1", wanted))
            return wanted
    return int(free_endpoint().rpartition(":")[2])


def open_page(url: str) -> bool:
    """Open a page if this computer has a screen and a browser; return whether it has."""
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return False  # a text browser in the terminal would take the keyboard
    try:
        return webbrowser.open(url)
    except webbrowser.Error:
        return False


async def run_tryout(
    clock: Clock,
    robot: Path,
    folder: Path,
    port: int,
    say: Callable[[str], None],
    *,
    browser: bool,
    calibrator: Calibrator | None = None,
) -> int:
    """Run emulated robot, daemon and page until SIGTERM, SIGINT or the end of one of them.

    Args:
        clock: source of time.
        robot: configuration of a simulated robot.
        folder: folder for logs, state and map.
        port: port of the page.
        say: receives a line for the terminal.
        browser: whether to open the page in a browser, if there is one.
        calibrator: the calibration wizards, for the page.

    Returns:
        The daemon's exit code.

    Raises:
        ConfigError: see ``write_tryout``.
    """
    endpoint = free_endpoint()
    file, config = write_tryout(robot, folder, endpoint)

    async def page(console: Commanded) -> None:
        world = EmulatedWorld(tuple(config.devices.present()), console.command)
        place = Place(port=port)
        station = Station(
            [RobotAddress(config.robot, endpoint)],
            clock,
            place,
            open_log=open_log,
            emulated=world,
            calibrator=calibrator,
        )
        opening: list[asyncio.Task[bool]] = []

        def ready() -> None:
            say(f"the page: {place.url}  (Ctrl-C ends everything)")
            if browser:
                opening.append(asyncio.create_task(in_thread(lambda: open_page(place.url))))

        await station.run(ready)

    return await serve(clock, [config], say, daemons_of=[file], beside=page)
