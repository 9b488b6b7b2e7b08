"""A lap of the demo: in one process on the virtual clock, reproducible, or over ptys on the wall clock.

On the wall clock the emulators are in one process, the daemon is in another, and the operator in this one.
"""

import asyncio
import contextlib
import gc
import os
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from rich.console import Console
from rich.live import Live

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import SECOND, Clock, VirtualClock, WallClock, run_virtual
from monstertruck_runtime.drives import TaskEnd
from monstertruck_runtime.errors import NoAnswerError, NotFoundError
from monstertruck_runtime.threads import in_thread
from monstertruck_runtime.yaml_files import yaml_text
from monstertruck_schemas.plan import ExplorationState
from monstertruckd.config.load import FILE_VERSION, load_config, load_tree
from monstertruckd.tools.demo.exploring import ExplorationSummary, Report, explore_home, summarised
from monstertruckd.tools.demo.summary import Summary, log_figures
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from monstertruckd.tools.simulation.operator import Lap, LocalOperator, drive_lap
from monstertruckd.tools.simulation.program import program
from monstertruckd.tools.simulation.virtual_rig import VirtualRig
from monstertruckd.tools.status.screen import draw
from monstertruckd.tools.status.watch import SCREEN_PERIOD, Follower

START_LIMIT = 60.0
"""Maximum time for the two processes to start (s); the first run compiles the ray caster."""


def run_fast_demo(config_file: Path, folder: Path, seed: int | None, film: Path | None = None) -> Summary:
    """Drive a lap on the virtual clock.

    Args:
        config_file: simulated truck's configuration.
        folder: folder for log, map and outputs.
        seed: seed of the world; None: the configuration's.
        film: GIF of the lap; engine mujoco only.

    Raises:
        NoAnswerError: the lap was not finished.
        InputError: there is nothing to film.
        NotInstalledError: this computer cannot draw.
    """
    overlay = write_overlay(config_file, folder, "tcp/127.0.0.1:0", seed)
    config, tree = load_config(overlay, SimulatedTruckConfig)
    wall = WallClock()

    async def main(clock: VirtualClock) -> tuple[VirtualRig, Lap, float]:
        rig = VirtualRig(config, clock, tree)
        begin_wall, begin = wall.now(), clock.now()
        gc.freeze()  # as the daemon does at its start
        async with rig.running(), _filmed(rig, clock, film):
            lap = await drive_lap(LocalOperator(rig.daemon, clock), clock)
            await clock.sleep(1.0)
            speed = (clock.now() - begin) / (wall.now() - begin_wall)
        return rig, lap, speed

    try:
        rig, lap, speed = run_virtual(main, start=SECOND)
    finally:
        gc.unfreeze()
    late = rig.daemon.gate.lateness()
    return Summary(
        lap,
        rig.truth.array(),
        late.p99,
        late.max,
        *log_figures(folder),
        digest=rig.daemon.digest.hexdigest(),
        speedup=speed,
        closed=config.path is not None and config.path.closed,
    )


def run_film(config_file: Path, film: Path, seconds: float) -> None:
    """Film a run on the virtual clock: the truck drives its path, or explores; people walk.

    Args:
        config_file: simulated truck's configuration.
        film: path of the GIF.
        seconds: duration of the run.

    Raises:
        InputError: there is nothing to film, or the file cannot be written.
        NotInstalledError: this computer cannot draw.
        RequestRefusedError: the truck cannot be armed.
    """
    with TemporaryDirectory(prefix="monstertruck-") as folder:
        config, tree = load_config(write_overlay(config_file, Path(folder), "tcp/127.0.0.1:0"), SimulatedTruckConfig)

        async def main(clock: VirtualClock) -> None:
            rig = VirtualRig(config, clock, tree)
            async with rig.running(), _filmed(rig, clock, film):
                operator = LocalOperator(rig.daemon, clock)
                begin = clock.now()
                await clock.sleep(3.0)  # seconds for the sensors, and a first map
                await operator.arm()
                if config.explorer is not None:
                    await operator.call("explore", {**await operator.header(), "order": "start"})
                await clock.sleep_until(begin + round(seconds * SECOND))

        run_virtual(main, start=SECOND)


@asynccontextmanager
async def _filmed(rig: VirtualRig, clock: VirtualClock, file: Path | None) -> AsyncIterator[None]:
    """Film the robot while the context is open."""
    if file is None:
        yield
        return
    from monstertruck_sim.world3d.onlookers import Film  # noqa: PLC0415  # the library of an extra

    with Film(rig.world, clock, file) as film:
        task = asyncio.create_task(film.run(), name="film")
        try:
            yield
        finally:
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task


def run_fast_exploration(config_file: Path, folder: Path, seed: int | None, report: Report) -> ExplorationSummary:
    """Explore on the virtual clock, find a tag if there are tags, and drive home.

    Args:
        config_file: configuration of a simulated robot with an explorer.
        folder: folder for log, map, report and outputs.
        seed: seed of the world; None: the configuration's.
        report: receives the progress.

    Raises:
        RequestRefusedError: the exploration does not start.
    """
    overlay = write_overlay(config_file, folder, "tcp/127.0.0.1:0", seed)
    config, tree = load_config(overlay, SimulatedTruckConfig)

    async def main(clock: VirtualClock) -> tuple[VirtualRig, TaskEnd[ExplorationState]]:
        rig = VirtualRig(config, clock, tree)
        async with rig.running():
            operator = LocalOperator(rig.daemon, clock)
            end = await explore_home(operator, clock, tags=seeks(config), report=report)
            await clock.sleep(1.0)
        return rig, end

    rig, end = run_virtual(main, start=SECOND)
    return summarised(end, rig.truth.array(), folder)


def seeks(config: SimulatedTruckConfig) -> bool:
    """Return whether the robot searches for a tag: its world has some, and it keeps points of interest."""
    return config.points is not None and bool(config.sim.world.tags)


async def run_wall_exploration(
    clock: Clock, config_file: Path, folder: Path, seed: int | None, report: Report
) -> ExplorationSummary:
    """Run it over ptys in real time; arguments and errors as in ``run_fast_exploration``.

    Raises:
        NoAnswerError: a process did not start.
    """
    config = load_config(config_file, SimulatedTruckConfig)[0]
    async with _served(clock, config_file, folder, seed) as client:
        end = await explore_home(client, clock, tags=seeks(config), report=report)
        await clock.sleep(1.0)
    with np.load(folder / "truth.npz") as archive:
        truth = archive["truth"]
    return await in_thread(lambda: summarised(end, truth, folder))


async def run_wall_demo(clock: Clock, config: Path, folder: Path, seed: int | None, *, screen: bool) -> Summary:
    """Drive a lap over ptys.

    Args:
        clock: source of time.
        config: simulated truck's configuration.
        folder: folder for configuration, log, picture and outputs of the processes.
        seed: replaces the configuration's own.
        screen: whether to draw the live screen.

    Raises:
        NoAnswerError: a process did not start, or the lap was not finished.
    """
    given = load_tree(config).data
    async with _served(clock, config, folder, seed) as client:
        follower = Follower(client, clock)
        watching = asyncio.create_task(_show(follower, clock, screen=screen))
        try:
            lap = await drive_lap(client, clock, timeout=START_LIMIT)
            await clock.sleep(1.0)
            if given.get("map"):
                await _appear((folder / "map.png").exists, clock)
        finally:
            watching.cancel()
            await asyncio.wait([watching])
        loop = follower.state.loop
    with np.load(folder / "truth.npz") as archive:
        rows = archive["truth"]
    return Summary(
        lap,
        rows,
        loop.lateness_p99 if loop else 0.0,
        loop.lateness_max if loop else 0.0,
        *log_figures(folder),
        closed=(given.get("path") or {}).get("closed", False),
    )


@asynccontextmanager
async def _served(clock: Clock, config: Path, folder: Path, seed: int | None) -> AsyncIterator[TruckClient]:
    """Run emulated robot and daemon as separate processes, with a client; the truth is written at the end."""
    endpoint = free_endpoint()
    overlay = write_overlay(config, folder, endpoint, seed)
    simulate = ("simulate", "--config", str(overlay), "--truth", str(folder / "truth.npz"))
    async with (
        program(folder / "simulate.txt", *simulate),
        _ready((folder / "simulate.txt").read_bytes, clock),
        program(folder / "daemon.txt", "run", "--config", str(overlay)),
        await connect(clock, load_tree(config).data.get("robot", "truck"), endpoint) as client,
    ):
        yield client


@asynccontextmanager
async def _ready(said: Callable[[], bytes], clock: Clock) -> AsyncIterator[None]:
    """Enter once the simulator has reported its devices."""
    try:
        async with clock.deadline(START_LIMIT):
            while b"ready" not in said():
                await clock.sleep(0.05)
    except TimeoutError:
        raise NoAnswerError(f"the simulator did not start within {START_LIMIT:g} s: {said()!r}") from None
    yield


def write_overlay(config: Path, folder: Path, endpoint: str, seed: int | None = None) -> Path:
    """Write a configuration that includes ``config``, with its devices on ptys and all output in ``folder``.

    Devices by hub and port are kept: their hubs belong to the emulated computer.
    """
    given = load_tree(config).data
    here = folder.resolve()
    by_path = (
        role for role, device in given.get("devices", {}).items() if device and "hub" not in (device.get("port") or ())
    )
    overlay: dict[str, Any] = {
        "include": str(config.resolve()),
        "version": FILE_VERSION,
        "devices": {role: {"port": {"path": str(here / "dev" / role)}} for role in by_path},
        "machine": str(here / "machine"),
        "zenoh": {"listen": [endpoint]},
        "recorder": {"directory": str(here / "logs")},
        "state_directory": str(here / "state"),
    }
    slam = given.get("slam") or {}
    if slam.get("mode") == "mapping" and not Path(slam.get("save") or "").is_absolute():
        overlay["slam"] = {"save": str(here / "explored")}
    if given.get("map"):
        overlay["map"] = {"picture": str(here / "map.png")}
    if seed is not None:
        overlay["sim"] = {"seed": seed}
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "config.yaml"
    file.write_text(yaml_text(overlay), encoding="utf-8")
    return file


def free_endpoint() -> str:
    """Return a loopback endpoint with a free port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


async def connect(clock: Clock, robot: str, endpoint: str) -> TruckClient:
    """Return a client, as soon as the daemon listens."""
    try:
        async with clock.deadline(START_LIMIT):
            while True:
                try:
                    async with TruckClient(robot, endpoint, clock=clock, timeout=0.5) as client:
                        if await client.alive():
                            break
                except NotFoundError:
                    await clock.sleep(0.2)
    except TimeoutError:
        raise NoAnswerError(f"the daemon did not start within {START_LIMIT:g} s at {endpoint}") from None
    return TruckClient(robot, endpoint, source=f"demo:{os.getpid()}", clock=clock)


async def _appear(exists: Callable[[], bool], clock: Clock) -> None:
    """Wait for the map, drawn by a low-priority worker; without it the summary does not list it."""
    with contextlib.suppress(TimeoutError):
        async with clock.deadline(15.0):
            while not exists():
                await clock.sleep(0.1)


async def _show(follower: Follower, clock: Clock, *, screen: bool) -> None:
    following = asyncio.create_task(follower.run())
    try:
        if not screen:
            await following
        with Live(console=Console(), screen=True, auto_refresh=False) as live:
            while True:
                live.update(draw(follower.state, live.console.width), refresh=True)
                await clock.sleep(SCREEN_PERIOD)
    finally:
        following.cancel()
        await asyncio.wait([following])
