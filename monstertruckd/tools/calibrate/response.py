"""Dead time and lag of an actuator with piecewise constant commands, from the measured effect.

``s`` seconds after the dead time, a command step of ``k`` has added ``k (s - lag (1 - exp(-s / lag)))`` to the time
integral of the response. A sensor measures this integral: the truck's turn for the steering, its distance for the
drive. The fit parameters are the delay (dead time plus lag) and the square of the lag: slow commands reveal only the
delay, and the lag appears as its square in the rounding of the response.
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
    """Times of the changes (s); (k,)."""
    changes: Array
    """Size of the changes; (k,)."""

    @classmethod
    def of(cls, stamps: Array, values: Array) -> "Steps":
        """Create the command from stamps (s) and command values (any unit); (n,) each, n > 0."""
        changes = np.diff(values)
        return cls(float(values[0]), stamps[1:][changes != 0.0], changes[changes != 0.0])

    def integral(self, at: Array, delay: float, squared: float) -> Array:
        """Time integral of the response, up to a constant, shape (n,).

        Args:
            at: times (s), shape (n,).
            delay: dead time plus lag (s).
            squared: square of the lag (s^2); values below 0, which are unphysical, are extrapolated from 0.
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
    """Residual of a measurement after subtracting the best linear combination of the causes; (n,) each."""
    basis = np.column_stack(causes)
    return np.asarray(measured - basis @ np.linalg.lstsq(basis, measured, rcond=None)[0])


@dataclass(frozen=True, slots=True)
class ResponseFit:
    """Fitted response to commands."""

    delay: Interval
    """Dead time plus lag (s)."""
    squared: Interval
    """Square of the lag (s^2); noise may make it negative."""
    samples: int
    """Number of residuals in the fit."""

    @classmethod
    def of(cls, residuals: Callable[[float, float], Array], wait: float, rounded: float = 0.0) -> "ResponseFit":
        """Fit the response by least squares.

        Args:
            residuals: function of the delay (s) and the squared lag (s^2); returns residuals in chronological order,
                shape (n,).
            wait: half the range of the time that commands may have to wait (s); the wait differs after each start and
                is uniformly distributed.
            rounded: maximum apparent squared lag caused by any other effect (s^2).

        Raises:
            InputError: the measurement does not depend on the parameters.
        """
        bounds = np.array((0.5, 0.2**2))  # maximum delay (s) and squared lag (s^2)
        fit = least_squares(
            lambda parameters: residuals(*parameters.tolist()), np.array((0.08, 0.03**2)), -bounds, bounds
        )
        if not np.isfinite(fit.standard_errors).all():
            raise InputError("dead time and lag cannot be determined: check that the robot follows its commands")
        halves = NORMAL * correlation_factor(fit.residuals) * fit.standard_errors
        delay, squared = (Interval(float(x), float(half)) for x, half in zip(fit.parameters, halves, strict=True))
        return cls(delay.joined(CONFIDENCE * wait), squared.widened(rounded), fit.residuals.size)

    def estimates(self, meanings: tuple[str, str, str], covers: str, prefix: str = "", key: str = "") -> list[Estimate]:
        """Estimates of dead time, lag and delay, as saved.

        Args:
            meanings: meaning of each estimate.
            covers: errors covered by the intervals.
            prefix: prefix of the estimates' names.
            key: configuration section for dead time and lag; empty if they are informational only.
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
