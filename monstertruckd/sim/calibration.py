"""Calibration against a world that hides the true values: an operator with tape, string and meter, and the judge."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from monstertruck_drivers.world.truck_plant import TruthState
from monstertruck_runtime.clock import SECOND, Clock, VirtualClock, run_virtual
from monstertruck_schemas import topics
from monstertruck_schemas.req import DriveRequest, Role
from monstertruckd.calibrate.apply import store_of, with_values
from monstertruckd.calibrate.guide import Wizard, calibrate
from monstertruckd.calibrate.record import Result
from monstertruckd.calibrate.steps import Confirm, Number
from monstertruckd.daemon import Daemon
from monstertruckd.demo.operator import LocalOperator
from monstertruckd.sim.config import SimulatedTruckConfig
from monstertruckd.sim.faults_drill import with_overlay
from monstertruckd.sim.rig import VirtualRig

START_UP: Final = 3.0
"""Seconds in which every device of the emulated truck is up."""


class LocalTruck(LocalOperator):
    """What a wizard needs of a client, inside the daemon's process."""

    def __init__(self, daemon: Daemon, clock: Clock, source: str = "calibrate") -> None:
        super().__init__(daemon.bus, clock, source)
        self.source = source
        self._daemon = daemon
        self._requests = 0

    async def drive(self, speed: float, front: float, rear: float = 0.0, lease: float = 0.3) -> None:
        """Inject a drive request as the bridge to Zenoh does."""
        while self._gate.latest is None:
            await self._gate.next()
        now = self._clock.now()
        self._requests += 1
        request = DriveRequest(
            stamp=now,
            received=now,
            seq=self._requests,
            source=self.source,
            role=Role.STATION,
            lease=lease,
            nonce=self._gate.latest.nonce,
            gate_stamp=self._gate.latest.stamp,
            speed=speed,
            front=front,
            rear=rear,
        )
        self._bus.inject(topics.REQ_DRIVE, request)

    async def call(self, rpc: str, payload: dict[str, Any] | None = None) -> dict[str, Any]:
        """Call one of the daemon's."""
        return await self._daemon.rpc.call(rpc, payload or {})


@dataclass(frozen=True, slots=True)
class Hands:
    """How well the operator measures; standard deviations unless it says bounds."""

    tape: float = 0.002
    """One reading of the tape, m"""
    string: float = 0.0035
    """Direction of a string laid along the truck's side, rad"""
    meter_share: float = 0.005
    """Bound of the meter's scale error"""
    meter_volts: float = 0.02
    """Bound of its other errors, V"""


class SimulatedOperator:
    """A ``Panel`` that looks at the world's truth with a tape, a string and a meter.

    Args:
        rig: the truck.
        rng: of the operator's errors.
        hands: how large they are.
        charges: of packs to be put in between two readings of the meter.
    """

    def __init__(
        self,
        rig: VirtualRig,
        rng: np.random.Generator,
        hands: Hands = Hands(),
        charges: tuple[float, ...] = (),
    ) -> None:
        self.said: list[str] = []
        self._rig = rig
        self._rng = rng
        self._hands = hands
        self._charges = list(charges)
        self._meter = float(rng.uniform(-hands.meter_share, hands.meter_share))
        self._mark = (0.0, 0.0)
        self._string = (0.0, 0.0, 0.0)
        self._before = self._truth()

    def say(self, text: str) -> None:
        """Listen."""
        self.said.append(text)

    def progress(self, name: str, done: float, total: float) -> None:
        """Wait."""

    async def number(self, step: Number) -> float:
        """Measure what is asked for."""
        truth = self._truth()
        match step.name:
            case "distance":
                x, y = self._bumper()
                return math.dist((x, y), self._mark) + self._error(self._hands.tape)
            case "offset":
                x, y, along = self._string
                across = -math.sin(along) * (truth.x - x) + math.cos(along) * (truth.y - y)
                return 100 * (across + self._error(self._hands.tape))
            case "meter":
                error = float(self._rng.uniform(-1, 1)) * self._hands.meter_volts
                return round(truth.supply_v * (1 + self._meter) + error, 2)
        raise AssertionError(step)

    async def confirm(self, step: Confirm) -> bool:
        """Do or see what is asked for."""
        truth = self._truth()
        match step.name:
            case "mark":
                x, y = self._bumper()
                self._mark = (x + self._error(self._hands.tape), y)
            case "string":
                self._string = (truth.x, truth.y, truth.yaw + self._error(self._hands.string))
            case "forward":
                before = self._before
                along = math.cos(before.yaw) * (truth.x - before.x) + math.sin(before.yaw) * (truth.y - before.y)
                return along > 0
            case "another":
                if self._charges:
                    self._rig.world.set_charge(self._rig.clock.now(), self._charges.pop(0))
                    await self._rig.clock.sleep(2.0)
                    return True
                return False
        self._before = truth
        return True

    def _truth(self) -> TruthState:
        return self._rig.world.truth(self._rig.clock.now())

    def _bumper(self) -> tuple[float, float]:
        """Middle of the front bumper on the floor."""
        truth, ahead = self._truth(), self._rig.config.sim.world.truck.length / 2
        return truth.x + math.cos(truth.yaw) * ahead, truth.y + math.sin(truth.yaw) * ahead

    def _error(self, sigma: float) -> float:
        return sigma * float(self._rng.standard_normal())


def hidden(config: SimulatedTruckConfig, rng: np.random.Generator, seed: int) -> SimulatedTruckConfig:
    """``config`` with a truck whose every calibrated value differs from what the daemon believes."""

    def servo(channel: int) -> dict[str, Any]:
        return {
            "channel": channel,
            "centre_us": 1439.2 + rng.uniform(-40, 40),
            "us_per_degree": float(rng.choice((-1, 1))) * 10.48 * rng.uniform(0.9, 1.1),
        }

    truck = {
        "wheel_radius": 0.075 * rng.uniform(0.95, 1.05),
        "motor": {"ratio": rng.uniform(500, 680), "inverted": bool(rng.integers(2))},
        "front_servo": servo(1),
        "rear_servo": servo(0),
    }
    hard = dict(zip(("hard_x", "hard_y", "hard_z"), rng.uniform(-70, 70, 3).tolist(), strict=True))
    soft = dict(zip(("soft_x", "soft_y", "soft_z"), rng.uniform(0.88, 1.12, 3).tolist(), strict=True))
    compass = {"iron": {**hard, **soft, "soft_xy": rng.uniform(-0.06, 0.06)}}
    battery = {"divider": 10 * rng.uniform(0.94, 1.06), "analog_offset": rng.uniform(-0.009, 0.009)}
    return with_overlay(
        config, {"sim": {"seed": seed, "world": {"truck": truck, "compass": compass, "battery": battery}}}
    )


@dataclass(frozen=True, slots=True)
class Session:
    """One run of a wizard on a simulated truck."""

    result: Result
    file: Path
    seconds: float
    """It took, on the truck's clock."""


def run_session(
    config: SimulatedTruckConfig,
    wizard: Wizard,
    rng: np.random.Generator,
    *,
    hands: Hands = Hands(),
    charges: tuple[float, ...] = (),
) -> Session:
    """Start the truck with the calibration in its state directory, run one wizard, end it, on a virtual clock.

    Raises:
        TruckError: whatever ended the wizard.
    """
    current = store_of(config).current()
    known = current.results if current is not None else {}
    calibrated = with_values(config, known.values(), "calibration")

    async def main(clock: VirtualClock) -> Session:
        rig = VirtualRig(calibrated, clock)
        async with rig.running():
            await clock.sleep(START_UP)
            operator = SimulatedOperator(rig, rng, hands, charges)
            began = clock.now()
            truck = LocalTruck(rig.daemon, clock)
            result, file = await calibrate(wizard, truck, operator, clock, calibrated, known)
            return Session(result, Path(file), (clock.now() - began) / SECOND)

    return run_virtual(main)
