"""Interruptions of a wizard at random instants: the old file is intact, the truck neutral, and the wizard runs again.

Every trial runs the whole daemon on the virtual clock. The drive wizard measures and is interrupted; the truck must
then be at rest with its gate closed and the calibration unchanged. The cause is removed, and the wizard runs again.
After a short interruption, a cable or link lost for a second, a wizard may also continue: the truck must then have
stood with its gate closed meanwhile, and the wizard must save its result.

A killed daemon closes its ports; the stop script's commands (``systemd/neutral.py``) then reach the drive, and a new
daemon starts, as under systemd.
"""

import asyncio
import logging
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks import ROOT
from monstertruck_drivers.epos.exchange import Exchanger
from monstertruck_drivers.epos.objects import CONTROLWORD
from monstertruck_drivers.epos.protocol import Control
from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.errors import TruckError
from monstertruck_runtime.mailbox import latest
from monstertruck_schemas import topics
from monstertruck_schemas.req import Role
from monstertruckd.config.calibration import CalibrationStore, Estimate, Result
from monstertruckd.config.load import load_config
from monstertruckd.tools.calibrate.drive import DriveWizard
from monstertruckd.tools.calibrate.wizard import calibrate
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig
from tests.calibration_kit import START_UP, SilentTruck, SimulatedOperator

FIRST, LAST = 2.0, 35.0
"""Seconds after the wizard's start between which it is interrupted: it takes 80 s."""
ENDED = 40.0
"""Seconds in which the wizard ends after that: a low battery is judged for ten."""
PASSES = ("unplug", "lease_lost")
"""Interruptions that a wizard may outlast."""
STOPPED = 8.0
"""Seconds within which the truck has stood after such an interruption."""
WHOLE = 300.0
"""Seconds within which the wizard is done after it."""
REST = 2.0
"""Seconds from then in which the truck is at rest."""
READY = 20.0
"""Seconds after which everything works again."""
FORGOTTEN, BRAKING = 0.55, 0.4
"""Seconds after which the controller has dropped half a frame, and in which it brakes: those of the stop script."""
STILL = 0.005
"""m/s."""
STEP = 0.05
"""Seconds between two looks."""
OLD = Result(
    wizard="drive",
    measured="long ago",
    estimates=(Estimate(name="drive_ratio", value=640.0, samples=4, meaning="test", key="geometry.drive_ratio"),),
)


@dataclass
class Trial:
    """Faults of one trial; none: an empty list."""

    kind: str
    instant: float
    wrong: list[str] = field(default_factory=list)


class Interrupted:
    """A truck, a measuring wizard, and the possible interruptions.

    Args:
        rig: the truck.
        clock: clock of the rig.
    """

    def __init__(self, rig: VirtualRig, clock: VirtualClock) -> None:
        self.rig, self.clock = rig, clock
        self.truck = SilentTruck(rig.daemon, clock)
        self.store = CalibrationStore(rig.config.calibration_folder, rig.config.robot)
        self.wizard: asyncio.Task[Any] = asyncio.create_task(self.measure(DriveWizard()))

    async def measure(self, wizard: DriveWizard) -> Result:
        """Run the wizard until its end or interruption."""
        panel = SimulatedOperator(self.rig, np.random.default_rng(1))
        truck: Any = self.truck
        result, _ = await calibrate(wizard, truck, panel, self.clock, self.rig.config, {})
        return result

    def files(self) -> dict[Path, bytes]:
        """Return the calibration files on the disk."""
        return {path: path.read_bytes() for path in self.store.files()}

    @property
    def speed(self) -> float:
        """True speed, m/s."""
        return abs(self.rig.world.truth(self.clock.now()).v)

    def operator(self) -> LocalOperator:
        """An operator with a gamepad."""
        return LocalOperator(self.rig.daemon, self.clock, "somebody", Role.GAMEPAD)

    # What happens, and what takes it back

    async def ctrl_c(self) -> None:
        """Interrupt the wizard."""
        self.wizard.cancel()

    async def unplug(self) -> None:
        """Unplug the drive for a second; its motor keeps its speed meanwhile."""
        self.rig.context.device("drive").port.unplug()
        await self.clock.sleep(1.0)
        self.rig.context.device("drive").port.plug()

    async def estop(self) -> None:
        """Send an emergency stop."""
        await self.operator().estop()

    async def reset(self) -> None:
        """Reset the emergency stop."""
        await self.operator().reset()

    async def low_battery(self) -> None:
        """Discharge the pack."""
        self.rig.world.set_charge(self.clock.now(), 0.01)

    async def charge(self) -> None:
        """Replace the pack."""
        self.rig.world.set_charge(self.clock.now(), 0.95)
        await self.clock.sleep(45.0)  # the battery counts as full only after a while

    async def lose_lease(self) -> None:
        """Cut the link for a second."""
        self.truck.silent = True
        await self.clock.sleep(1.0)
        self.truck.silent = False

    async def kill_wizard(self) -> None:
        """Kill the wizard: it sends nothing more."""
        self.truck.silent = True
        self.wizard.cancel()

    async def hear_again(self) -> None:
        """Start a new process of the wizard."""
        self.truck.silent = False

    async def kill_daemon(self) -> None:
        """Kill the daemon, run the stop script, and start a new daemon."""
        ports = list(self.rig.ports.values())
        for port in ports:
            port.unplug()
        self.truck.silent = True
        await self.rig.cut()
        self.wizard.cancel()  # its link is gone
        for port in ports:
            port.plug()
        async with await self.rig.ports["drive"].open() as link:
            controller = Exchanger(link, self.clock, self.rig.config.devices.drive.driver.node)  # type: ignore[union-attr]
            await self.clock.sleep(FORGOTTEN)
            await controller.write(CONTROLWORD, Control.QUICK_STOP)
            await self.clock.sleep(BRAKING)
            await controller.write(CONTROLWORD, Control.DISABLE_VOLTAGE)
        await self.clock.sleep(1.0)
        self.rig.give()
        self.truck = SilentTruck(self.rig.daemon, self.clock)

    async def nothing(self) -> None:
        """No cause to remove."""


Happens = Callable[[Interrupted], Awaitable[None]]
KINDS: dict[str, tuple[Happens, Happens]] = {
    "ctrl_c": (Interrupted.ctrl_c, Interrupted.nothing),
    "unplug": (Interrupted.unplug, Interrupted.nothing),
    "estop": (Interrupted.estop, Interrupted.reset),
    "low_battery": (Interrupted.low_battery, Interrupted.charge),
    "lease_lost": (Interrupted.lose_lease, Interrupted.nothing),
    "kill_wizard": (Interrupted.kill_wizard, Interrupted.hear_again),
    "kill_daemon": (Interrupted.kill_daemon, Interrupted.nothing),
}
"""What happens, and what is done before the wizard is run again."""


def trial(kind: str, seed: int) -> Trial:
    """Run one trial."""
    logging.disable(logging.CRITICAL)
    instant = float(np.random.default_rng([seed, 28]).uniform(FIRST, LAST))
    found = Trial(kind, round(instant, 2))
    base = load_config(ROOT / "configs" / "yard.yaml", SimulatedTruckConfig)[0]
    with TemporaryDirectory(prefix="monstertruck-") as folder:
        overlay = {
            "recorder": None,
            "blackbox": None,
            "state_directory": Path(folder),
            "sim": {"world": {"map": "yard"}},
        }
        config = with_overlay(base, overlay)
        CalibrationStore(config.calibration_folder, config.robot).save(OLD, 0)

        async def main(clock: VirtualClock) -> None:
            rig = VirtualRig(config, clock)
            async with rig.running():
                await clock.sleep(START_UP)
                await _interrupt(Interrupted(rig, clock), found)

        run_virtual(main)
    return found


async def _interrupt(bench: Interrupted, found: Trial) -> None:
    happens, taken_back = KINDS[found.kind]
    before = bench.files()
    await bench.clock.sleep(found.instant)
    if bench.wizard.done():
        found.wrong.append("the wizard had ended before")
        return
    standing = asyncio.create_task(_stands(bench))
    await happens(bench)
    await asyncio.wait([bench.wizard], timeout=ENDED)
    if found.kind in PASSES and await _outlasted(bench, await standing, found):
        return
    standing.cancel()
    if not bench.wizard.done():
        found.wrong.append("the wizard goes on")
        bench.wizard.cancel()
        await asyncio.wait([bench.wizard])
    elif not bench.wizard.cancelled():
        error = bench.wizard.exception()
        if not isinstance(error, TruckError):
            found.wrong.append(f"the wizard ended with {error!r}")
    await bench.clock.sleep(REST)
    if bench.speed > STILL:
        found.wrong.append(f"it moves at {bench.speed:.3f} m/s")
    if bench.files() != before:
        found.wrong.append("the calibration has changed")
    async with _mode(bench) as gate:
        await bench.clock.sleep(1.0)
        if gate.latest is None or gate.latest.mode.active:
            found.wrong.append(f"the gate is {gate.latest.mode if gate.latest else 'silent'}")
    await taken_back(bench)
    await bench.clock.sleep(READY)
    try:
        await bench.measure(DriveWizard(runs=3, metres=0.4))
    except TruckError as error:
        found.wrong.append(f"it does not go on: {error}")
    else:
        if len(bench.files()) != len(before) + 1:
            found.wrong.append("the second run was not saved")


async def _outlasted(bench: Interrupted, stood: bool, found: Trial) -> bool:
    """Whether the wizard continues to its end after the interruption."""
    before = bench.files()
    if not bench.wizard.done():
        if not stood:
            found.wrong.append("it was not stopped")
        await asyncio.wait([bench.wizard], timeout=WHOLE)
        if bench.wizard.done() and bench.wizard.exception() is None and len(bench.files()) != len(before) + 1:
            found.wrong.append("it went on, and saved nothing")
    return bench.wizard.done() and bench.wizard.exception() is None


async def _stands(bench: Interrupted) -> bool:
    """Whether the truck soon stands with its gate closed."""
    async with _mode(bench) as gate:
        for _ in range(round(STOPPED / STEP)):
            await bench.clock.sleep(STEP)
            if bench.speed <= STILL and gate.latest is not None and not gate.latest.mode.active:
                return True
    return False


@asynccontextmanager
async def _mode(bench: Interrupted) -> AsyncIterator[Any]:
    with bench.rig.bus.subscribe(topics.GATE, latest()) as gate, suppress(asyncio.CancelledError):
        yield gate


def interruptions(count: int) -> tuple[dict[str, Any], dict[str, Any], bool]:
    """Run this many trials of each kind; return the successful ones, the goals, and whether they are met."""
    good: dict[str, int] = {}
    for kind in KINDS:
        trials = [trial(kind, seed) for seed in range(count)]
        for one in trials:
            for what in one.wrong:
                print(f"{kind} after {one.instant:.2f} s: {what}", flush=True)
        good[kind] = sum(not one.wrong for one in trials)
        print(f"{kind}: {good[kind]} of {count}", flush=True)
    return {"count": count, "as_it_should_be": good}, {"as_it_should_be": count}, set(good.values()) == {count}
