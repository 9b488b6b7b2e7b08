"""Controller loads: the motor shaft and the steering servo arms."""

from collections import deque
from math import copysign, exp, floor, pi, radians

from monstertruck_sim.world.config import MotorConfig, ServoModelConfig

RPM = 2 * pi / 60
"""One revolution per minute (rad/s)."""


class Shaft:
    """Motor under a speed controller: ramped demand followed by a first-order lag; forward positive."""

    def __init__(self, config: MotorConfig) -> None:
        self._config = config
        self.target: float | None = None
        """Speed at the end of the ramp (rpm); None: the power stage is off."""
        self._acceleration = 0.0
        self.turns = 0.0
        self.rpm = 0.0
        self.demand_rpm = 0.0
        self.slope = 0.0
        """Current acceleration (rpm/s)."""
        self.blocked = False
        """Whether the shaft is held, whatever the motor does."""

    def command(self, target_rpm: float | None, accel_rpm_s: float) -> None:
        """Ramp towards a speed; None switches the power stage off."""
        if self.target is None:
            self.demand_rpm = self.rpm
        self.target = target_rpm
        self._acceleration = abs(accel_rpm_s)

    @property
    def powered(self) -> bool:
        """Whether the power stage is on."""
        return self.target is not None

    def step(self, dt: float) -> None:
        """Advance by ``dt`` seconds."""
        before = self.rpm
        if self.target is None:
            self.demand_rpm = 0.0
            rpm = _towards(before, 0.0, self._config.coast_rpm_s * dt)
        else:
            demand = self.demand_rpm = _towards(self.demand_rpm, self.target, self._acceleration * dt)
            rpm = demand + (before - demand) * exp(-dt / self._config.lag)
            if demand == 0.0 and abs(rpm) < 0.5:
                rpm = 0.0
        if self.blocked:
            rpm = 0.0
        self.rpm = rpm
        self.turns += (before + rpm) / 2 * dt / 60
        self.slope = (rpm - before) / dt


class Servo:
    """Hobby servo: quantises its pulse, ignores small changes, and turns with a delay and at a limited rate.

    Without pulses, the servo is limp.

    Args:
        config: true pulse map and limits.
    """

    def __init__(self, config: ServoModelConfig) -> None:
        self._config = config
        self._left_stop = radians(config.left_stop_deg)
        self._right_stop = -radians(config.right_stop_deg)
        self._held_us: float | None = None
        self._target = 0.0
        """Target angle of the arm (rad)."""
        self._elapsed = 0.0
        """Elapsed time (s)."""
        self._due: deque[tuple[float, float]] = deque()
        """Times (s) at which the angles (rad) of newer pulses become the target."""
        self.angle = 0.0
        """Angle of the arm (rad)."""

    def latch(self, pulse_us: float | None) -> None:
        """Process one pulse; without pulses (None), the arm remains in place."""
        if pulse_us is None:
            self._held_us = None
            return
        measured = floor(pulse_us / self._config.resolution_us + 0.5) * self._config.resolution_us
        if self._held_us is None or abs(measured - self._held_us) > self._config.dead_band_us:
            self._held_us = measured
            target = radians((measured - self._config.centre_us) / self._config.us_per_degree)
            target = min(max(target, self._right_stop), self._left_stop)
            self._due.append((self._elapsed + self._config.dead_time, target))

    def step(self, dt: float) -> None:
        """Turn towards the target for ``dt`` seconds."""
        end = self._elapsed + dt
        while self._due and self._due[0][0] < end - 1e-9:
            at, target = self._due.popleft()
            self._turn(at - self._elapsed)
            self._elapsed, self._target = at, target
        self._turn(end - self._elapsed)
        self._elapsed = end

    def _turn(self, dt: float) -> None:
        if self._held_us is not None and self.angle != self._target:
            lag = self._config.lag
            target = self._target if lag == 0.0 else self._target + (self.angle - self._target) * exp(-dt / lag)
            self.angle = _towards(self.angle, target, self._config.rate * dt)


def _towards(value: float, target: float, step: float) -> float:
    left = target - value
    return target if abs(left) <= step else value + copysign(step, left)
