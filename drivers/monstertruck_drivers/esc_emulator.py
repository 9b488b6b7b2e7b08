"""Emulated speed controller (ESC) with a pulse input.

A real one reads a pulse every 20 ms, does not move before it has received neutral pulses for a while, lets the motor
coast without pulses, and gives no motor feedback.
"""

import math
from collections.abc import Callable

from monstertruck_drivers.emulation import MotorPlant
from monstertruck_drivers.servos import EscPulses
from monstertruck_runtime.clock import SECOND, Clock


class EscEmulator:
    """Speed controller with its motor.

    Args:
        esc: pulse settings.
        clock: time.
        plant: the motor.
        pulse: returns the pulse width at the input (us) at a time (ns); None without pulses.
    """

    def __init__(self, esc: EscPulses, clock: Clock, plant: MotorPlant, pulse: Callable[[int], float | None]) -> None:
        self._esc = esc
        self._clock = clock
        self._plant = plant
        self._pulse = pulse
        self._neutral_since: int | None = None
        self._armed = False

    async def run(self) -> None:
        """Follow the pulses until cancelled."""
        while True:
            await self._clock.sleep(0.02)  # seconds between two pulses
            now = self._clock.now()
            pulse = self._pulse(now)
            if pulse is None:
                self._armed, self._neutral_since = False, None
                self._plant.command(now, None, 1.0)
                continue
            self._arm(pulse, now)
            rate = self._esc.rate(pulse) if self._armed and not self._is_neutral(pulse) else 0.0
            slowing = self._esc.deceleration if rate else self._esc.quick_deceleration
            rpm = math.tau / 60
            self._plant.command(now, rate / rpm, slowing / rpm)

    def _is_neutral(self, pulse: float) -> bool:
        return abs(pulse - self._esc.neutral_us) <= 10.0  # us

    def _arm(self, pulse: float, now: int) -> None:
        if not self._is_neutral(pulse):
            self._neutral_since = None
        elif self._neutral_since is None:
            self._neutral_since = now
        elif now - self._neutral_since >= self._esc.arming * SECOND / 2:
            self._armed = True
