"""Daemon, emulated devices and world on one virtual loop: for the fast demo, tests and drills."""

import asyncio
import os
import select
import signal
from collections.abc import AsyncIterator
from contextlib import ExitStack, asynccontextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from monstertruck_drivers.cable import MemoryPort
from monstertruck_drivers.usb.config import UsbPortConfig
from monstertruck_runtime.clock import VirtualClock, on_computer
from monstertruck_runtime.threads import inline
from monstertruck_schemas.sensor import StandPose
from monstertruck_schemas.topics import STAND_POSE
from monstertruck_sim.computer import EmulatedComputer
from monstertruck_sim.faults import FaultInjector, SimContext
from monstertruck_sim.robot import SimulatedRobot
from monstertruck_sim.stand import SimulatedStand
from monstertruck_sim.world.scene import Surroundings
from monstertruckd.bus.local import Bus
from monstertruckd.config.load import Tree
from monstertruckd.daemon import Daemon
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from monstertruckd.tools.simulation.simulate import TruthLog

IN_MEMORY: Final = "/dev/shm"  # noqa: S108 - a new folder is made in it
"""A disk would be waited for at every change of an emulated file."""


class VirtualRig:
    """A complete robot in one process; all random numbers derive from the configuration's seed.

    Args:
        config: configuration of the simulated truck.
        clock: clock of the running virtual loop.
        tree: origins of the configuration's values.
        scene: world shared with other rigs of the same clock; None for its own.
    """

    def __init__(
        self,
        config: SimulatedTruckConfig,
        clock: VirtualClock,
        tree: Tree | None = None,
        scene: Surroundings | None = None,
    ) -> None:
        self.config = config
        self.clock = clock
        self.began = clock.now()
        """Start of the world, ns."""
        self._folder = TemporaryDirectory(
            prefix="monstertruck-", dir=IN_MEMORY if os.access(IN_MEMORY, os.W_OK | os.X_OK) else None
        )
        self.ports = {role: MemoryPort(role) for role in config.devices.present()}
        with ExitStack() as unless:
            unless.callback(self._folder.cleanup)
            self.computer = EmulatedComputer(Path(self._folder.name), config.devices, self.ports, clock)
            self.robot = SimulatedRobot(
                config.sim,
                config.devices,
                config.monitors,
                clock,
                self.computer.ports,
                self.computer.folder,
                offload=inline,
                scene=scene,
                name=config.robot,
            )
            unless.pop_all()
        self.world = self.robot.world
        self.truth = TruthLog(self.world, clock)
        self._tree = tree
        self._starts = 0
        self.daemon = self._new_daemon()
        self._stop = asyncio.Event()
        self._daemon_task: asyncio.Task[None] | None = None

    @property
    def bus(self) -> Bus:
        """Bus of the current daemon."""
        return self.daemon.bus

    @property
    def context(self) -> SimContext:
        """Targets of faults."""
        config = self.config
        disk = self.daemon.recorder
        return SimContext(
            config.sim, config.devices, self.robot, self.computer, self.clock, disk, power=self, workers=self
        )

    @asynccontextmanager
    async def running(self) -> AsyncIterator["VirtualRig"]:
        """Run world, devices and daemon while the context is open; the daemon ends first, in order.

        Raises:
            BaseException: error that ended the daemon early.
        """
        around = [
            asyncio.create_task(self.robot.run(), name="robot"),
            asyncio.create_task(self.truth.run(), name="truth"),
        ]
        if self.config.stand == "simulator":
            sim = self.config.sim
            seed = sim.seed if sim.world.noise else None
            stand = SimulatedStand(sim.stand, self.world, self.clock, self._put_stand, seed)
            around.append(asyncio.create_task(stand.run(), name="stand"))
        if (drill := self.config.sim.drill) is not None:
            around.append(asyncio.create_task(FaultInjector(self.context, drill).run(), name="faults"))
        self._start_daemon()
        try:
            yield self
        finally:
            try:
                await self.end_daemon()
            finally:
                for task in around:
                    task.cancel()
                await asyncio.wait(around)
                self._folder.cleanup()

    def _put_stand(self, pose: StandPose) -> None:
        self.bus.put_stand(STAND_POSE, pose)

    # The computer's supply

    async def cut(self) -> None:
        """Remove the daemon at once; its cables must be unplugged before."""
        assert self._daemon_task is not None
        self._daemon_task.cancel()
        await asyncio.wait([self._daemon_task])

    def give(self) -> None:
        """Start a new daemon on the same robot; subscriptions to the previous one receive nothing from it."""
        self.daemon = self._new_daemon()
        self._start_daemon()

    # The daemon's worker processes

    def kill(self, name: str) -> None:
        """Kill a worker as SIGKILL does, and wait until it is dead; no effect if it does not run."""
        pid = self.daemon.worker_pids().get(name)
        if pid is not None:
            process = os.pidfd_open(pid)
            os.kill(pid, signal.SIGKILL)
            select.select((process,), (), ())
            os.close(process)

    def _new_daemon(self) -> Daemon:
        devices = self.config.devices.present()
        by_path = {r: port for r, port in self.ports.items() if not isinstance(devices[r].port, UsbPortConfig)}
        seed = self.config.sim.seed + self._starts
        self._starts += 1
        computer = self.computer.computer()
        return Daemon(self.config, self.clock, ports=by_path, computer=computer, tree=self._tree, seed=seed)

    def _start_daemon(self) -> None:
        self._daemon_task = asyncio.create_task(self.daemon.run(self._stop), name="daemon", context=on_computer())

    @property
    def daemon_ended(self) -> bool:
        """Whether the daemon has ended."""
        return self._daemon_task is not None and self._daemon_task.done()

    async def end_daemon(self) -> None:
        """End the daemon as SIGTERM does, and wait until it has ended."""
        self._stop.set()
        assert self._daemon_task is not None
        if not self._daemon_task.cancelled():
            await self._daemon_task
