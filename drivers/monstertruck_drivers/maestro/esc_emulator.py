"""Maestro with a speed controller (ESC) on one of its channels.

A real speed controller reads a pulse every 20 ms, does not move before it has received neutral pulses for a while, lets
the motor coast without pulses, and gives no feedback of the motor.
"""

import asyncio
import math
from typing import Final

from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.emulation import EmulatorSetup, MotorPlant, ServoPlant
from monstertruck_drivers.maestro.emulator import MaestroEmulator
from monstertruck_drivers.maestro.esc_config import MaestroEscConfig
from monstertruck_runtime.clock import SECOND, Clock

NEAR: Final = 10.0
"""Tolerance around the neutral pulse (us)."""


class MaestroEscEmulator(MaestroEmulator):
    """The unit, its servos, and the speed controller with its motor.

    Faults (``inject``): all faults of ``MaestroEmulator``.

    Args:
        clock: time.
        plant: the motor.
        servos: physics of the servos.
        settings: channels and pulses.
        seed: seed of the analog noise.
    """

    def __init__(
        self,
        clock: Clock,
        plant: MotorPlant,
        servos: ServoPlant | None = None,
        settings: MaestroEscConfig | None = None,
        *,
        seed: int = 0,
    ) -> None:
        config = settings or MaestroEscConfig()
        self._esc = config.esc
        self._plant = plant
        self._neutral_since: int | None = None
        self._armed = False
        outputs = frozenset({2, 3, 4} - {config.esc.channel})
        super().__init__(
            clock,
            servos,
            seed=seed,
            serial_timeout_s=0.2,  # seconds; set once in the unit, by the maker's tool
            home={config.esc.channel: config.esc.neutral_us},
            outputs=outputs,
        )

    async def run(self, end: DeviceEnd) -> None:
        """Serve the Command Port, and let the speed controller read its pulses."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._obey_pulses())
            await super().run(end)

    async def _obey_pulses(self) -> None:
        while True:
            await self._clock.sleep(0.02)  # seconds between two pulses
            now = self._clock.now()
            pulse = self.pulse_us(self._esc.channel, now) if self._powered else None
            if pulse is None:
                self._armed, self._neutral_since = False, None
                self._plant.command(now, None, 1.0)
                continue
            self._arm(pulse, now)
            rate = self._esc.rate(pulse) if self._armed and abs(pulse - self._esc.neutral_us) > NEAR else 0.0
            slowing = self._esc.deceleration if rate else self._esc.quick_deceleration
            rpm = math.tau / 60
            self._plant.command(now, rate / rpm, slowing / rpm)

    def _arm(self, pulse: float, now: int) -> None:
        if abs(pulse - self._esc.neutral_us) > NEAR:
            self._neutral_since = None
        elif self._neutral_since is None:
            self._neutral_since = now
        elif now - self._neutral_since >= self._esc.arming * SECOND / 2:
            self._armed = True


def emulated(setup: EmulatorSetup) -> MaestroEscEmulator:
    """The servo and speed controller of a simulated robot."""
    return MaestroEscEmulator(
        setup.clock, setup.physics.motors[0], setup.physics.servos, setup.settings, seed=setup.seed
    )
