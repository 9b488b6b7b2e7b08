"""LiPo pack: coulomb counting, fast and slow sag, measured through a divider and an RC filter."""

from math import exp

from monstertruck_drivers.battery.monitor import CELL_VOLTS
from monstertruck_sim.world.config import BatteryModelConfig

_CELL_VOLTS: list[float] = CELL_VOLTS.tolist()


def rest_voltage(charge: float, cells: int) -> float:
    """Return the open-circuit voltage of a pack at a charge of 0..1 (widely used table, 5 % steps)."""
    steps = len(_CELL_VOLTS) - 1
    place = min(max(charge, 0.0), 1.0) * steps
    below = min(int(place), steps - 1)
    low, high = _CELL_VOLTS[below], _CELL_VOLTS[below + 1]
    return cells * (low + (high - low) * (place - below))


class BatteryModel:
    """State of the pack, advanced by ``step``.

    Args:
        config: parameters and initial charge.
    """

    def __init__(self, config: BatteryModelConfig) -> None:
        self._config = config
        self._slow_sag = 0.0
        self.current = 0.0
        """Current into the pack (A)."""
        self.connected = True
        """Whether the pack is plugged in."""
        self.set_charge(config.charge)
        self._filtered = self.volts

    def set_charge(self, charge: float) -> None:
        """Replace the pack with one at another charge (0..1)."""
        self.charge = charge
        self._rest = rest_voltage(charge, self._config.cells)
        self.volts = self._loaded(self._config.electronics_w / self._rest)

    @property
    def analog_volts(self) -> float:
        """Voltage after the divider and filter."""
        return self._filtered / self._config.divider + self._config.analog_offset

    def step(self, dt: float, motor_w: float, charger_a: float = 0.0) -> None:
        """Draw the power of the electronics and the motor for ``dt`` seconds, less a charger's current."""
        config = self._config
        current = (config.electronics_w + motor_w) / max(self.volts, 1.0) - charger_a
        self.current = -current
        self.charge = min(max(0.0, self.charge - current * dt / 3600 / config.capacity_ah), 1.0)
        self._rest = rest_voltage(self.charge, config.cells)
        self._slow_sag += (current * config.recovery_resistance - self._slow_sag) * _share(dt, config.recovery_time)
        self.volts = self._loaded(current)
        self._filtered += (self.volts - self._filtered) * _share(dt, config.filter_time)

    def _loaded(self, current: float) -> float:
        if not self.connected:
            return 0.0
        return max(0.0, self._rest - current * self._config.resistance - self._slow_sag)


def _share(dt: float, time_constant: float) -> float:
    """Fraction of a step response reached after ``dt``."""
    return 1.0 - exp(-dt / time_constant)
