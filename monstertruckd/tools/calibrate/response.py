"""Dead time and lag of what follows commands that are piecewise constant, from what they brought about.

``s`` seconds after the dead time a change of the command by ``k`` has added ``k (s - lag (1 - exp(-s / lag)))`` to its
integral over time, which a sensor sees: turns of the truck by the steering, distance by the drive. Fitted are the delay
(dead time and lag together) and the square of the lag: the delay is all that slow commands show, and the lag shows by
its square in how they are rounded off.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.fitting import least_squares
from monstertruck_runtime.errors import InputError
from monstertruckd.config.calibration import CONFIDENCE, Estimate
from monstertruckd.tools.calibrate.statistics import NORMAL, Interval, correlation_factor


@dataclass(frozen=True, slots=True)
class Steps:
    """A piecewise constant command."""

    first: float
    """Value before the first change."""
    times: Array
    """Times of the changes, s; (k,)."""
    changes: Array
    """Size of the changes; (k,)."""

    @classmethod
    def of(cls, stamps: Array, values: Array) -> "Steps":
        """From commands, s and any unit; (n,) each, n > 0."""
        changes = np.diff(values)
        return cls(float(values[0]), stamps[1:][changes != 0.0], changes[changes != 0.0])

    def integral(self, at: Array, delay: float, squared: float) -> Array:
        """Of what follows it, over time, up to a constant; (n,).

        Args:
            at: s; (n,).
            delay: dead time and lag, s.
            squared: square of the lag, s^2; below 0, where nothing can be, it is extrapolated from 0.
        """
        lag = math.sqrt(abs(squared))
        found = self._lagged(at, delay - lag, lag)
        return found if squared >= 0.0 else 2.0 * self._lagged(at, delay, 0.0) - found

    def _lagged(self, at: Array, dead_time: float, lag: float) -> Array:
        since = np.maximum(at[:, None] - self.times - dead_time, 0.0)
        if lag > 0.0:
            since += lag * np.expm1(-since / lag)
        return np.asarray(self.first * at + since @ self.changes)


def unexplained(measured: Array, *causes: Array) -> Array:
    """What the best sum of the causes leaves of a measurement; (n,) each."""
    basis = np.column_stack(causes)
    return np.asarray(measured - basis @ np.linalg.lstsq(basis, measured, rcond=None)[0])


@dataclass(frozen=True, slots=True)
class ResponseFit:
    """How something follows commands."""

    delay: Interval
    """Dead time and lag together, s."""
    squared: Interval
    """Square of the lag, s^2; may be below 0 by the noise."""
    samples: int
    """Residuals that it rests on."""

    @classmethod
    def of(cls, residuals: Callable[[float, float], Array], wait: float, rounded: float = 0.0) -> "ResponseFit":
        """Least squares.

        Args:
            residuals: from the delay (s) and the square of the lag (s^2), in the order of time; (n,).
            wait: half the range of a time, s, for which commands may have to wait, another one after each start; as
                likely anywhere in it.
            rounded: greatest square of a lag, s^2, that anything else may look like.

        Raises:
            InputError: the measurement does not depend on them.
        """
        bounds = np.array((0.5, 0.2**2))  # greatest delay (s) and square of the lag (s^2)
        fit = least_squares(
            lambda parameters: residuals(*parameters.tolist()), np.array((0.08, 0.03**2)), -bounds, bounds
        )
        if not np.isfinite(fit.standard_errors).all():
            raise InputError("dead time and lag do not show: does the robot follow its commands?")
        halves = NORMAL * correlation_factor(fit.residuals) * fit.standard_errors
        delay, squared = (Interval(float(x), float(half)) for x, half in zip(fit.parameters, halves, strict=True))
        return cls(delay.joined(CONFIDENCE * wait), squared.widened(rounded), fit.residuals.size)

    def estimates(self, meanings: tuple[str, str, str], covers: str, prefix: str = "", key: str = "") -> list[Estimate]:
        """Dead time, lag and delay, as they are saved.

        Args:
            meanings: of each.
            covers: what their intervals cover.
            prefix: of their names.
            key: section of the configuration that takes dead time and lag; none: for information only.
        """
        roots = (math.sqrt(max(x, 0.0)) for x in (self.squared.value, self.squared.low, self.squared.high))
        lag, least, greatest = roots
        delay = self.delay
        rows = (
            ("dead_time", delay.value - lag, delay.low - greatest, delay.high - least),
            ("lag", lag, least, greatest),
            ("delay", delay.value, delay.low, delay.high),
        )
        return [
            Estimate(
                name=prefix + name,
                value=max(value, 0.0),
                low=max(low, 0.0),
                high=max(high, 0.0),
                unit="s",
                samples=self.samples,
                meaning=f"{meaning}; {covers}",
                key=f"{key}.{name}" if key and name != "delay" else None,
            )
            for (name, value, low, high), meaning in zip(rows, meanings, strict=True)
        ]
