"""``monstertruckd simulate``: emulated robots in one process, with their devices behind ptys."""

import asyncio
import math
import signal
import sys
from array import array
from collections.abc import Callable, Coroutine, Iterator, Mapping, Sequence
from contextlib import AsyncExitStack, ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from monstertruck_drivers.cable import EmulatedPort, PtyPort, SocketPort
from monstertruck_drivers.config import PortConfig, TcpPortConfig
from monstertruck_drivers.hokuyo_urg.recording import RecordedHokuyoEmulator
from monstertruck_drivers.webcam.emulator import WebcamEmulator
from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT
from monstertruck_runtime.errors import BusyError, InputError, NotFoundError
from monstertruck_runtime.memory import settle
from monstertruck_sim.computer import EmulatedComputer
from monstertruck_sim.config import CeilingCamera
from monstertruck_sim.console import Commanded, CommandedGroup, Emulated, EmulatedFiles, FaultConsole
from monstertruck_sim.faults import FaultInjector, SimContext
from monstertruck_sim.robot import SimulatedRobot
from monstertruck_sim.stand import SimulatedStand
from monstertruck_sim.world.config import HeldBoard
from monstertruck_sim.world.obstacles import Box, Disc, penetration
from monstertruck_sim.world.scene import Surroundings
from monstertruck_sim.world.world import World
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, needs_computer
from monstertruckd.tools.simulation.emulate import claimed
from monstertruckd.tools.simulation.fleet import shared_scene
from monstertruckd.tools.simulation.program import program
from monstertruckd.tools.simulation.tape import EmulatedTape

Say = Callable[[str], None]
Beside = Callable[[Commanded], Coroutine[Any, Any, None]]
ANOTHER: Final = (
    "probably another `simulate` on this computer; end it with Ctrl-C in its terminal. A second robot "
    "needs a configuration with another `robot` and `zenoh: listen`"
)
"""Advice for ports that are in use."""


ROOM_WORDS: Final = "room post X Y (an upright post at a place of the world, m), room clear (remove all posts)"
MOST_POSTS: Final = 50
"""Posts at one time: every one costs time in each scan."""


class EmulatedRoom:
    """Posts in a world, seen by the robot's sensors; they stop it on contact.

    Args:
        world: world with the robot.
        clock: source of time.
        body: length and width of the robot (m).
    """

    def __init__(self, world: World, clock: Clock, body: tuple[float, float]) -> None:
        self._world, self._clock, self._body = world, clock, body
        self._posts: list[Disc] = []

    def command(self, words: list[str]) -> None:
        """Add a post, or remove all.

        Raises:
            InputError: unknown words, a place occupied by the robot, or too many posts.
        """
        now = self._clock.now()
        match words:
            case ["post", x, y]:
                try:
                    post = Disc(float(x), float(y), 0.1)  # m
                except ValueError:
                    raise InputError(f"expected {ROOM_WORDS}") from None
                if not (math.isfinite(post.x) and math.isfinite(post.y)):
                    raise InputError(f"expected {ROOM_WORDS}")
                self._put(now, post)
            case ["clear"]:
                while self._posts:
                    self._world.remove(now, self._posts.pop())
            case _:
                raise InputError(f"expected {ROOM_WORDS}")

    def _put(self, now: int, post: Disc) -> None:
        if len(self._posts) >= MOST_POSTS:
            raise InputError(f"{MOST_POSTS} posts are already in the room; remove them first")
        robot = self._world.truth(now)
        if penetration(Box(robot.x, robot.y, *self._body, robot.yaw), post) > 0:
            raise InputError(f"post at {post.x:.2f}, {post.y:.2f} m: the robot is there")
        self._world.add(now, post)
        self._posts.append(post)


class TruthLog:
    """True state of the simulated truck, 20 times a second; for evaluation, never for the daemon."""

    COLUMNS = ("time", "x", "y", "yaw", "speed", "stuck")

    def __init__(self, world: World, clock: Clock) -> None:
        self._world = world
        self._clock = clock
        self._samples = array("d")

    async def run(self) -> None:
        """Sample until cancelled."""
        due = self._clock.now()
        while True:
            now = self._clock.now()
            state = self._world.truth(now)
            self._samples.extend((now / SECOND, state.x, state.y, state.yaw, state.v, float(state.stuck)))
            due += SECOND // 20  # 20 Hz
            await self._clock.sleep_until(due)

    def array(self) -> Array:
        """Return the samples, (n, 6): ``COLUMNS``, s, m, m, rad, m/s, 0 or 1."""
        return np.array(self._samples).reshape(-1, len(self.COLUMNS))


async def serve(
    clock: Clock,
    configs: Sequence[SimulatedTruckConfig],
    say: Say,
    truth: Path | None = None,
    daemons_of: Sequence[Path] = (),
    beside: Beside | None = None,
) -> int:
    """Serve the devices of robots in one world behind ptys at their configured ports until SIGTERM or SIGINT.

    Faults are read from standard input. Each line begins with the device's role, the monitor's name, or ``usb``;
    ``tape`` measures. With several robots the robot's name precedes it.

    Args:
        clock: source of time.
        configs: the robots; of several ``as_fleet`` has made sure that they can share a world.
        say: receives a line for the terminal: answers to commands, contacts, ready devices.
        truth: file of the true motion.
        daemons_of: configurations of daemons to run meanwhile; they are stopped before the devices, and when all have
            ended by themselves the devices are stopped, too.
        beside: runs meanwhile, with the command handler; its end ends everything.

    Returns:
        The exit code of the first daemon that failed by itself, else 0.

    Raises:
        NotPermittedError: this user may not create a port there.
        InputError: ``machine`` or a port names an existing file or folder instead of a link; or two robots overlap.
        BusyError: another program serves one of the ports.
        OSError: a port cannot be created.
    """
    ports = (it.port for config in configs for it in config.devices.present().values())
    links = [port.path for port in ports if isinstance(port, PortConfig)]
    links += [camera.port for config in configs for camera in config.sim.stand.cameras.values()]
    with ExitStack() as stack:
        try:
            stack.enter_context(claimed(*links))
        except BusyError as error:
            raise BusyError(f"{error}: {ANOTHER}") from None
        scene = shared_scene(configs)
        scene.on_contact = lambda contact: say(str(contact))
        robots = []
        for config in configs:
            folder = Path(stack.enter_context(TemporaryDirectory(prefix="monstertruck-")))
            stack.enter_context(_linked(config, folder))
            robots.append(ServedRobot(config, clock, folder, scene, say, keeps_truth=truth is not None))
        return await _serve(clock, robots, say, truth, daemons_of, beside)


@contextmanager
def _linked(config: SimulatedTruckConfig, folder: Path) -> Iterator[None]:
    """Link ``machine`` to the folder of the emulated computer if the daemon needs one."""
    if not needs_computer(config):
        yield
        return
    link = config.machine
    if link.exists() and not link.is_symlink():
        raise InputError(f"machine: {link} exists: choose a free name for the link to the emulated computer")
    with claimed(link):
        link.unlink(missing_ok=True)
        link.symlink_to(folder, target_is_directory=True)
        try:
            yield
        finally:
            link.unlink(missing_ok=True)


class ServedRobot:
    """One robot with its devices behind ptys.

    Args:
        config: configuration of the robot.
        clock: source of time.
        folder: folder of its emulated computer.
        scene: the world.
        say: receives a line for the terminal.
        keeps_truth: whether to keep the true motion until the end, 80 MB a day.
    """

    def __init__(
        self,
        config: SimulatedTruckConfig,
        clock: Clock,
        folder: Path,
        scene: Surroundings,
        say: Say,
        *,
        keeps_truth: bool,
    ) -> None:
        self.config, self._clock = config, clock
        devices = config.devices.present()
        cables: dict[str, EmulatedPort] = {}
        for role, device in devices.items():
            if isinstance(device.port, TcpPortConfig):
                cables[role] = SocketPort(device.port.address, device.port.tcp)
                continue
            path = device.port.path if isinstance(device.port, PortConfig) else folder / "cables" / role
            path.parent.mkdir(parents=True, exist_ok=True)
            cables[role] = PtyPort(path)
        self._computer = EmulatedComputer(folder, config.devices, cables, clock)
        self._robot = SimulatedRobot(
            config.sim,
            config.devices,
            config.monitors,
            clock,
            self._computer.ports,
            folder,
            scene=scene,
            name=config.robot,
        )
        self.truth = TruthLog(self._robot.world, clock)
        self._keeps_truth = keeps_truth
        emulated: dict[str, Commanded] = {
            role: Emulated(self._robot.emulators[role], self._robot.ports[role]) for role in devices
        }
        emulated |= {name: EmulatedFiles(files) for name, files in self._robot.monitored.items()}
        body = config.sim.world.truck.length, config.sim.world.truck.width
        emulated |= {"usb": self._computer, "tape": EmulatedTape(self._robot.world, clock, body, say)}
        emulated["room"] = EmulatedRoom(self._robot.world, clock, body)
        self.console = CommandedGroup("device", emulated)

    def tasks(self, say: Say) -> Iterator[asyncio.Task[Any]]:
        """Yield all tasks that run while it is served; ``say`` receives lines without the robot's name."""
        config, world, clock = self.config, self._robot.world, self._clock
        yield asyncio.create_task(self._robot.run(), name=config.robot)
        if self._keeps_truth:
            yield asyncio.create_task(self.truth.run(), name="truth")
        if config.stand == "simulator":
            yield asyncio.create_task(_see(clock, config, world), name="stand")
        for i, (name, camera) in enumerate(config.sim.stand.cameras.items()):
            watching = _watch(clock, world, camera, config.sim.stand.board, config.sim.seed + i)
            yield asyncio.create_task(watching, name=f"camera {name}")
        if config.sim.drill is not None:
            context = SimContext(config.sim, config.devices, self._robot, self._computer, clock)
            yield asyncio.create_task(FaultInjector(context, config.sim.drill, say).run(), name="faults")
        if self._robot.recorded is not None:
            yield asyncio.create_task(_report_end(self._robot.recorded, say), name="recording")


async def _serve(
    clock: Clock,
    robots: Sequence[ServedRobot],
    say: Say,
    truth: Path | None,
    daemons_of: Sequence[Path],
    beside: Beside | None,
) -> int:
    alone = len(robots) == 1
    stop = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    tasks: list[asyncio.Task[Any]] = []
    for robot in robots:
        prefix = "" if alone else f"{robot.config.robot}: "
        tasks += robot.tasks(lambda line, prefix=prefix: say(prefix + line))  # type: ignore[misc]
    known = CommandedGroup("robot", {robot.config.robot: robot.console for robot in robots})
    target = robots[0].console if alone else known
    console = FaultConsole(target, sys.stdin, say)
    tasks.append(asyncio.create_task(console.run(), name="console"))
    if beside is not None:
        tasks.append(asyncio.create_task(beside(target), name="beside"))
    waiting = asyncio.create_task(stop.wait())
    settle()
    if not daemons_of:  # who will say themselves when all of their services are
        say("ready")
    ended_by = 0
    async with AsyncExitStack() as stack:
        if daemons_of:
            programs = [
                await stack.enter_async_context(program(None, "run", "--config", str(file))) for file in daemons_of
            ]
            names = [robot.config.robot for robot in robots]
            tasks.append(daemons := asyncio.create_task(_last_end(programs, names, say), name="daemons"))
        await asyncio.wait([waiting, *tasks], return_when=asyncio.FIRST_COMPLETED)
        if daemons_of and daemons.done():
            ended_by = daemons.result()
    for task in (waiting, *tasks):
        task.cancel()
    results = await asyncio.gather(*tasks, return_exceptions=True)
    if truth is not None:
        save_truth(truth, {"truth" if alone else robot.config.robot: robot.truth for robot in robots})
    for result in results:
        if isinstance(result, Exception):
            raise result
    return ended_by


def save_truth(file: Path, logs: Mapping[str, TruthLog]) -> None:
    """Write the true motions, as one array for each log, by name."""
    arrays: dict[str, Any] = {name: log.array() for name, log in logs.items()}
    np.savez(file, **arrays)


async def _last_end(programs: Sequence[asyncio.subprocess.Process], names: Sequence[str], say: Say) -> int:
    """Wait until all daemons have ended; return the first exit code of a failure."""
    codes: list[int] = []

    async def end(process: asyncio.subprocess.Process, name: str) -> None:
        codes.append(code := await process.wait())
        if len(programs) > 1:
            say(f"{name}: its daemon ended with code {code}")

    await asyncio.gather(*map(end, programs, names))
    return next((code for code in codes if code), 0)


async def _see(clock: Clock, config: SimulatedTruckConfig, world: World) -> None:
    """Print the true pose of the robot whenever a daemon is running."""
    endpoint = next(iter(config.zenoh.listen), DEFAULT_ENDPOINT)
    while True:
        try:
            async with TruckClient(config.robot, endpoint, clock=clock) as client:
                seed = config.sim.seed if config.sim.world.noise else None
                await SimulatedStand(config.sim.stand, world, clock, client.publish_stand_pose, seed).run()
        except NotFoundError:
            await clock.sleep(1.0)  # seconds between two looks for a daemon


async def _watch(clock: Clock, world: World, camera: CeilingCamera, board: HeldBoard | None, seed: int) -> None:
    """Serve a camera of the stand."""
    from monstertruck_sim.world3d.onlookers import CeilingView  # noqa: PLC0415  # the library of an extra

    camera.port.parent.mkdir(parents=True, exist_ok=True)
    port = PtyPort(camera.port)
    emulator = WebcamEmulator(clock, CeilingView(world, camera, board, seed))
    try:
        port.plug()
        await emulator.run(port.device)
    finally:
        port.unplug()


async def _report_end(recorded: RecordedHokuyoEmulator, say: Say) -> None:
    await recorded.finished.wait()
    say(f"recording sent, began {recorded.began}")
    await asyncio.Event().wait()
