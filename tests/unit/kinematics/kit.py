"""Round trips of the sources' fitted polynomials."""

import numpy as np

from monstertruck_kinematics.polynomials import Coefficients, polynomial

H_PRINTED = (0.5334, 0.2997, 0.2857, 0.0556, 1.4951, 0.0)
"""Left wheel to servo as eq. 2.8 prints it; the library inverts f instead."""


def round_trip_error(there: Coefficients, back: Coefficients, limit: float) -> float:
    """Largest |back(there(x)) - x| for |x| up to ``limit``, rad: how well two fitted directions agree."""
    x = np.linspace(-limit, limit, 2001)
    return float(np.abs(polynomial(back, polynomial(there, x)) - x).max())
