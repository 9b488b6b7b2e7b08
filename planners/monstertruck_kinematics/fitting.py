"""Bounded robust least squares in plain numpy, with standard errors: shared by all identifications."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from monstertruck_kinematics.elementary import Array, KinematicsError


@dataclass(frozen=True)
class FitResult:
    """Result of a fit.

    Attributes:
        parameters: (n,) best parameters.
        standard_errors: (n,) of the parameters, from the curvature at the optimum and the residuals' spread; infinite
            for a parameter on its bound or not determined by the data.
        residuals: (m,) unweighted residuals at the optimum.
    """

    parameters: Array
    standard_errors: Array
    residuals: Array

    @property
    def rms(self) -> float:
        """Root mean square residual."""
        return float(np.sqrt(np.mean(self.residuals**2)))

    @property
    def worst(self) -> float:
        """Largest residual, absolute."""
        return float(np.abs(self.residuals).max())


def least_squares(
    residual: Callable[[Array], Array],
    start: Array,
    lower: Array,
    upper: Array,
    *,
    huber: float | None = None,
    iterations: int = 200,
) -> FitResult:
    """Minimise the (Huber-weighted) squares of ``residual`` within bounds: Levenberg-Marquardt with an active set.

    Args:
        residual: function from the (n,) parameters to (m,) residuals.
        start: (n,) first guess within the bounds.
        lower: (n,) lower bounds, -inf for none; equal bounds fix a parameter.
        upper: (n,) upper bounds, inf for none.
        huber: residual above which a sample counts linearly; None weights all samples equally.
        iterations: maximum number of iterations.

    Raises:
        KinematicsError: start outside the bounds, fewer residuals than parameters, or non-finite residuals.
    """
    point, value = _solve(residual, start, lower, upper, huber, iterations)
    return FitResult(point, _standard_errors(residual, point, lower, upper, value, huber), value)


def _solve(
    residual: Callable[[Array], Array], start: Array, lower: Array, upper: Array, huber: float | None, iterations: int
) -> tuple[Array, Array]:
    """Return the optimum and its residuals."""
    point = np.array(start, dtype=np.float64)
    if ((point < lower) | (point > upper)).any():
        raise KinematicsError(f"start {point.tolist()} is outside the bounds")
    value = residual(point)
    if value.size < point.size:
        raise KinematicsError(f"{value.size} residuals cannot determine {point.size} parameters")
    if not np.isfinite(value).all():
        raise KinematicsError("residuals are not finite at the start")
    damping = 1e-3
    cost = _cost(value, huber)
    for _ in range(iterations):
        jacobian = _slopes(residual, point, lower, upper)
        weights = _weights(value, huber)
        gradient = jacobian.T @ (weights * value)
        free = (lower < upper) & ~(((point <= lower) & (gradient > 0.0)) | ((point >= upper) & (gradient < 0.0)))
        scale = np.maximum(np.sqrt(np.einsum("ij,i,ij->j", jacobian, weights, jacobian)), 1e-100)
        if not free.any() or np.abs(gradient / scale)[free].max() <= 1e-12 * (1.0 + np.sqrt(cost)):
            break
        hessian = (jacobian.T * weights) @ jacobian
        improved = False
        while damping < 1e12 and not improved:
            step = np.zeros_like(point)
            matrix = hessian[np.ix_(free, free)] / np.outer(scale[free], scale[free])
            lifted = matrix + damping * np.eye(int(free.sum()))
            step[free] = -np.linalg.solve(lifted, gradient[free] / scale[free]) / scale[free]
            trial = np.clip(point + step, lower, upper)
            moved = residual(trial)
            trial_cost = _cost(moved, huber) if np.isfinite(moved).all() else np.inf
            improved = trial_cost < cost
            damping = max(damping / 5.0, 1e-9) if improved else damping * 4.0
        if not improved:
            break
        settled = cost - trial_cost <= 1e-15 * cost
        point, value, cost = trial, moved, trial_cost
        damping = min(damping, 1.0)
        if settled:
            break
    return point, value


def minimax(
    residual: Callable[[Array], Array], start: Array, lower: Array, upper: Array, *, rounds: int = 12
) -> FitResult:
    """Minimise the largest absolute residual: least squares in ever higher norms (2, 4, ... 2^rounds).

    The largest residual found exceeds the true optimum by less than m^(1/2^rounds). Standard errors have no meaning
    here and are infinite. Arguments and errors as ``least_squares``.
    """
    point, _ = _solve(residual, start, lower, upper, None, 200)
    for power in range(1, rounds):
        height = np.abs(residual(point)).max()
        if height < 1e-9:
            break
        half = float(2**power)

        def raised(x: Array, height: float = float(height), half: float = half) -> Array:
            relative = residual(x) / height
            exponent = half * np.log(np.maximum(np.abs(relative), 1e-300))
            return np.asarray(np.sign(relative) * np.exp(np.minimum(exponent, 300.0)))

        sharper, _ = _solve(raised, point, lower, upper, None, 60)
        if np.abs(residual(sharper)).max() <= height:
            point = sharper
    return FitResult(point, np.full(point.size, np.inf), residual(point))


def _cost(value: Array, huber: float | None) -> float:
    size = np.abs(value)
    with np.errstate(over="ignore"):
        if huber is None:
            return float(0.5 * np.sum(size**2))
        return float(np.sum(np.where(size <= huber, 0.5 * size**2, huber * (size - 0.5 * huber))))


def _weights(value: Array, huber: float | None) -> Array:
    if huber is None:
        return np.ones_like(value)
    return np.asarray(np.minimum(1.0, huber / np.maximum(np.abs(value), 1e-300)))


def _slopes(residual: Callable[[Array], Array], point: Array, lower: Array, upper: Array) -> Array:
    """(m, n) central differences, one-sided at a bound."""
    columns = []
    for k in range(point.size):
        width = 6e-6 * max(abs(float(point[k])), 1e-2)
        ahead, behind = point.copy(), point.copy()
        ahead[k] = min(point[k] + width, upper[k])
        behind[k] = max(point[k] - width, lower[k])
        columns.append((residual(ahead) - residual(behind)) / max(ahead[k] - behind[k], 1e-300))
    return np.column_stack(columns)


def _standard_errors(
    residual: Callable[[Array], Array], point: Array, lower: Array, upper: Array, value: Array, huber: float | None
) -> Array:
    """Square roots of the diagonal of s^2 (J^T W J)^-1 over the parameters that are off their bounds."""
    errors = np.full(point.size, np.inf)
    free = (point > lower) & (point < upper)
    freedom = value.size - int(free.sum())
    if not free.any() or freedom <= 0:
        return errors
    weights = _weights(value, huber)
    jacobian = _slopes(residual, point, lower, upper)[:, free] * np.sqrt(weights)[:, None]
    scale = np.linalg.norm(jacobian, axis=0)
    if (scale == 0.0).any():
        return errors
    _, singular, basis = np.linalg.svd(jacobian / scale, full_matrices=False)
    if singular[-1] < 1e-9 * singular[0]:
        return errors
    spread = float(np.sum(weights * value**2)) / freedom
    errors[free] = np.sqrt(spread * np.sum((basis.T / singular) ** 2, axis=1)) / scale
    return errors
