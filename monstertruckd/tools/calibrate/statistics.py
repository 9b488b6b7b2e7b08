"""Confidence intervals from a small number of measurements."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.fitting import FitResult
from monstertruckd.config.calibration import Estimate

_T: Final = (
    12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228,
    2.201, 2.179, 2.160, 2.145, 2.131, 2.120, 2.110, 2.101, 2.093, 2.086,
    2.080, 2.074, 2.069, 2.064, 2.060, 2.056, 2.052, 2.048, 2.045, 2.042,
)  # fmt: skip
"""Two-sided 95 % quantiles of Student's t distribution, by degrees of freedom, starting with 1."""

NORMAL: Final = 1.960


def student(freedom: int) -> float:
    """Half-width of a 95 % interval in standard errors, for a sample spread with ``freedom`` degrees of freedom.

    Raises:
        ValueError: ``freedom`` is less than one.
    """
    if freedom < 1:
        raise ValueError(f"{freedom} degrees of freedom: expected at least 1")
    return _T[freedom - 1] if freedom <= len(_T) else NORMAL + 2.4 / freedom


@dataclass(frozen=True, slots=True)
class Interval:
    """A value and half the width of its 95 % interval."""

    value: float
    half: float

    @property
    def low(self) -> float:
        """Lower end."""
        return self.value - self.half

    @property
    def high(self) -> float:
        """Upper end."""
        return self.value + self.half

    def widened(self, bound: float) -> "Interval":
        """Widen by a systematic error of at most ``bound`` in either direction."""
        return Interval(self.value, self.half + bound)

    def joined(self, half: float) -> "Interval":
        """Widen by an independent error with a 95 % half-width of ``half``, added in quadrature."""
        return Interval(self.value, math.hypot(self.half, half))

    def times(self, factor: float) -> "Interval":
        """Scale by an exact factor."""
        return Interval(self.value * factor, self.half * abs(factor))


def estimated(name: str, found: Interval, unit: str, samples: int, meaning: str, key: str | None = None) -> Estimate:
    """Create an estimate from its interval; for the other arguments see ``Estimate``."""
    return Estimate(
        name=name,
        value=found.value,
        low=found.low,
        high=found.high,
        unit=unit,
        samples=samples,
        meaning=meaning,
        key=key,
    )


def mean_angle(angles: Array) -> float:
    """Circular mean of directions (rad)."""
    return math.atan2(float(np.sin(angles).mean()), float(np.cos(angles).mean()))


def mean_interval(values: ArrayLike, least_error: float = 0.0) -> Interval:
    """Mean of repeated measurements.

    Args:
        values: (n,), n > 1.
        least_error: minimum standard deviation of one measurement, even if the values agree better.
    """
    data = np.asarray(values, dtype=np.float64)
    count = data.size
    spread = student(count - 1) * float(data.std(ddof=1))
    return Interval(float(data.mean()), max(spread, NORMAL * least_error) / math.sqrt(count))


def correlation_factor(residuals: Array) -> float:
    """Factor by which correlated errors inflate a fit's standard error; at least 1.

    It is the root of the integrated autocorrelation; the sum ends at the first correlation below zero (Sokal's window,
    simplified).

    Args:
        residuals: residuals in chronological order, shape (n,).
    """
    centred = residuals - residuals.mean()
    power = float(centred @ centred)
    if power == 0.0 or centred.size < 4:
        return 1.0
    total = 1.0
    for lag in range(1, centred.size // 2):
        correlation = float(centred[lag:] @ centred[:-lag]) / power
        if correlation <= 0.0:
            break
        total += 2.0 * correlation
    return math.sqrt(total)


def known_errors(fit: FitResult, freedom: int) -> Array:
    """Half-widths of the intervals of a fit's parameters if the residuals are in units of known errors; shape (n,).

    If the measurements disagree by more than the known errors, their spread is used.

    Args:
        fit: fit of residuals divided by their standard deviations.
        freedom: number of measurements, not counting priors, minus the number of parameters.
    """
    power = float(np.sum(fit.residuals**2))
    unit = math.sqrt(power / max(1, fit.residuals.size - fit.parameters.size))
    spread = math.sqrt(power / max(freedom, 1))
    factor = NORMAL if spread <= 1.0 or freedom < 1 else student(freedom) * spread
    return np.asarray(fit.standard_errors / max(unit, 1e-12) * factor)
