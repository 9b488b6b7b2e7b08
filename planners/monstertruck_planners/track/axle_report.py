"""Operator report on the learnt axle errors: which axle deviates from its calibration, and why.

Servo gain and slip have the same effect at a single speed. Their combined effect is evaluated at the speed where the
covariance makes it most certain. A difference is reported once it exceeds its standard deviation, combined with the
calibration uncertainty, by a factor large enough for the reported number to be right.
"""

import math
from typing import Final, Literal, NamedTuple

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.track.axle_errors import AxleErrorEstimator
from monstertruck_schemas.plan import AxleDeviation

NAMES: Final[tuple[Literal["front", "rear"], ...]] = ("front", "rear")

TURN: Final = np.array(((0.5, 0, 0, 0.5, 0, 0), (0, 1.0, 0, 0, -1.0, 0), (0, 0, 0.5, 0, 0, 0.5)))
"""Weights of the estimator's numbers when only the turn is known, not the axle that causes it: mean gain, trim
difference, mean slip."""

Name = Literal["front", "rear", "both axles"]


class _Estimate(NamedTuple):
    """An estimate and its standard deviation, including the tolerance of a calibrated truck."""

    value: float
    deviation: float

    @property
    def sure(self) -> bool:
        """Whether the value differs from 0 for certain."""
        # Threshold of a reported difference, in standard deviations: the difference is then known to a quarter.
        return abs(self.value) > 4.0 * self.deviation

    @property
    def gone(self) -> bool:
        """Whether the value may be 0."""
        return abs(self.value) <= self.deviation


class _Finding(NamedTuple):
    """Errors of one axle, or of both if only their combined errors are known."""

    name: Name
    share: _Estimate
    """Excess turn at ``speed``, as a fraction; servo and slip combined."""
    servo: _Estimate
    """Excess turn caused by the servo, as a fraction."""
    slip: _Estimate
    """Slip (rad s^2/m)."""
    trim: _Estimate
    """Trim (rad), left positive."""
    speed: float
    """Speed with the best knowledge of ``share`` (m/s)."""

    def sentence(self) -> str:
        """Return the differences as text; empty if there are none."""
        parts = []
        if self.servo.sure:
            parts.append(f"{_percent(self.servo.value)} than calibrated")
        elif self.slip.sure:
            parts.append(
                f"{math.degrees(abs(self.slip.value)):.1f} degrees less for each m/s^2 of lateral acceleration, by slip"
            )
        elif self.share.sure:
            parts.append(
                f"{_percent(self.share.value)} than calibrated at {self.speed:.1f} m/s, by its servo or by slip "
                "(drive at another speed to learn which)"
            )
        if self.trim.sure:
            side = "left" if self.trim.value > 0.0 else "right"
            parts.append(f"{math.degrees(abs(self.trim.value)):.1f} degrees to the {side}")
        verb = "steer" if self.name == "both axles" else "steers"
        return f"{self.name} {verb} {', '.join(parts)}" if parts else ""

    @property
    def servo_differs(self) -> bool:
        """Whether a calibration would help."""
        return self.servo.sure or self.trim.sure

    @property
    def gone(self) -> bool:
        """Whether the differences have disappeared."""
        return self.share.gone and self.trim.gone


class SteeringReport(NamedTuple):
    """Comparison of the steering with its calibration."""

    text: str
    """Known differences; empty if there are none."""
    agrees: bool
    """Whether every estimate is within one standard deviation of the calibration."""
    axles: tuple[AxleDeviation, ...]


def report(estimator: AxleErrorEstimator, wheelbase: float) -> SteeringReport:
    """Compare the estimate with the calibration.

    Args:
        estimator: axle error estimator.
        wheelbase: wheelbase (m).
    """
    state, covariance = estimator.state, estimator.covariance
    alone = [_finding(name, np.eye(6)[3 * k : 3 * k + 3], state, covariance, wheelbase) for k, name in enumerate(NAMES)]
    together = _finding("both axles", TURN, state, covariance, wheelbase)
    found = [one for one in alone if one.sentence()] or ([together] if together.sentence() else [])
    text = "; ".join(one.sentence() for one in found)
    if any(one.servo_differs for one in found):
        text += ": `calibrate steering`"
    rows = tuple(
        AxleDeviation(
            axle=name,
            gain=1.0 + one.servo.value,
            gain_deviation=math.sqrt(covariance[3 * k, 3 * k]),
            trim=one.trim.value,
            trim_deviation=math.sqrt(covariance[3 * k + 1, 3 * k + 1]),
            slip=one.slip.value,
            slip_deviation=one.slip.deviation,
            samples=estimator.samples,
            servo_differs=(together if together in found else one).servo_differs,
        )
        for k, (name, one) in enumerate(zip(NAMES, alone, strict=True))
    )
    return SteeringReport(text, together.gone and all(one.gone for one in alone), rows)


def _finding(name: Name, rows: Array, state: Array, covariance: Array, wheelbase: float) -> _Finding:
    """Return the finding for gain, trim and slip; each of ``rows`` (3, 6) weights the estimator's six numbers."""
    mean, spread = rows @ state, rows @ covariance @ rows.T
    # Lateral acceleration per rad that minimises the combined variance of gain and slip.
    grip = max(float(spread[0, 2] / spread[2, 2]), 0.0) if spread[2, 2] > 0.0 else 0.0
    both = float(spread[0, 0] - 2.0 * grip * spread[0, 2] + grip**2 * spread[2, 2])
    # Standard deviations of gain and trim (rad) of a calibrated axle: `calibrate steering` aims at intervals (95 %)
    # of 2.5 % for the scale and half a degree of the servo for the centre; the axle turns 0.64 times as far.
    gain, trim = (0.025 / 1.96, math.radians(0.5) * 0.64 / 1.96)
    known = float(np.abs(rows[1]).sum())
    return _Finding(
        name,
        share=_Estimate(float(mean[0] - grip * mean[2]), math.sqrt(max(both, 0.0) + gain**2)),
        servo=_Estimate(float(mean[0]), math.sqrt(spread[0, 0] + gain**2)),
        slip=_Estimate(float(mean[2]), math.sqrt(spread[2, 2])),
        trim=_Estimate(float(mean[1]), math.sqrt(spread[1, 1] + known * trim**2)),
        speed=math.sqrt(grip * wheelbase),
    )


def _percent(share: float) -> str:
    return f"{abs(share) * 100:.0f} % {'more' if share > 0.0 else 'less'}"
