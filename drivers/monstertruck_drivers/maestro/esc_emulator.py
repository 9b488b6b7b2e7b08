"""Maestro with a speed controller (ESC) on one of its channels."""

import asyncio

from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.emulation import EmulatorSetup, MotorPlant, ServoPlant
from monstertruck_drivers.esc_emulator import EscEmulator
from monstertruck_drivers.maestro.emulator import MaestroEmulator
from monstertruck_drivers.maestro.esc_config import MaestroEscConfig
from monstertruck_runtime.clock import Clock


class MaestroEscEmulator(MaestroEmulator):
    """The unit, its servos, and the speed controller with its motor.

    Faults (``inject``): all faults of ``MaestroEmulator``.

    Args:
        clock: time.
        plant: the motor.
        servos: servo physics.
        settings: channels and pulses.
        seed: seed for the analog noise.
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
        self._channel = config.esc.channel
        self._esc = EscEmulator(config.esc, clock, plant, self._pulse)
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
        """Serve the Command Port, and run the speed controller from its pulses."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._esc.run())
            await super().run(end)

    def _pulse(self, now: int) -> float | None:
        return self.pulse_us(self._channel, now) if self._powered else None


def emulated(setup: EmulatorSetup) -> MaestroEscEmulator:
    """Create a simulated robot's servo and speed controller."""
    return MaestroEscEmulator(
        setup.clock, setup.physics.motors[0], setup.physics.servos, setup.settings, seed=setup.seed
    )
