"""Model-predictive control of both axles: a quadratic programme over the coming seconds, re-linearised at each step.

The model is the error from the path as in ``error_model``, but with the axle angles themselves, exact tangents and the
curved frame of the path. Prediction bridges the dead time, the lag is in the model, and angles and rates are limits.
States are eliminated (condensed form), so the programme has one or two unknowns per period. Each step linearises once
about the last plan shifted by one period (real-time iteration: Diehl, Bock and Schloeder, SIAM J. Control Optim. 43,
2005).

The programme is solved exactly by a dual active-set method (DAQP: Arnstrom, Bemporad and Axehill, IEEE Transactions on
Automatic Control 67, 2022). It starts at the unconstrained optimum and adds the violated limits one by one. A step at
its limits therefore takes hardly longer than an unlimited one, and equal inputs give equal outputs.
"""

import math
from dataclasses import dataclass

import daqp
import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.track.config import MpcConfig
from monstertruck_planners.track.error_model import BASES, LEAST_LAG
from monstertruck_planners.track.lqr import GainTable
from monstertruck_planners.track.path_tracker import STEEPEST, Angles, PathTracker, TrackingState
from monstertruck_planners.track.response import Response
from monstertruck_planners.track.segments import ReferenceStates
from monstertruck_schemas.plan import Steering


@dataclass(frozen=True, slots=True)
class Layout:
    """Matrices that depend only on the steering modes of all periods."""

    bases: Array
    """Axle angles of each period's inputs, shape (k, 2, m); an input without effect has zeros."""
    onto: Array
    """Map from the first period's axle angles to its inputs, shape (m, 2)."""
    effect: Array
    """Map from the plan to the axle angles in the middle of each fine step, shape (f, 2, k m)."""
    weights: Array
    """Weights of the squared errors, shape (2 f,)."""


@dataclass(frozen=True, slots=True)
class Rollout:
    """Errors along a plan at the end of each fine step, and their derivatives."""

    errors: Array
    """Distances, then yaw errors, shape (2 f,)."""
    by_plan: Array
    """Derivatives by the plan, shape (2 f, n)."""


@dataclass(frozen=True, slots=True)
class Terminal:
    """Errors after the last period, their derivatives by the plan, and their infinite-horizon cost."""

    errors: Array
    """Distance and yaw error, shape (2,)."""
    by_plan: Array
    """Derivatives by the plan, shape (2, unknowns)."""
    cost: Array
    """Weights of the infinite-horizon cost, shape (2, 2)."""


class Mpc(PathTracker[MpcConfig]):
    """Model-predictive tracker; see the module."""

    def __init__(self, config: MpcConfig, geometry: FourWheelSteering) -> None:
        super().__init__(config, geometry)
        self._periods = min(max(math.ceil(config.preview * config.rate), 2), 30)
        # Maximum integration step of the errors (s).
        per = max(math.ceil(self.period / 0.05 - 1e-9), 1)
        self._h = self.period / per
        self._fine = self._periods * per
        self._times = (np.arange(self._periods, dtype=np.float64) + 0.5) * self.period
        self._middles = (np.arange(self._fine, dtype=np.float64) + 0.5) * self._h
        self._lag, self._fading = self._responses()
        self._layouts: dict[tuple[Steering, ...], Layout] = {}
        self._gains = GainTable(config, geometry, 1)
        self._solvers: dict[int, Solver] = {}
        self._plan: Array | None = None
        self._planned: tuple[Steering, ...] = ()

    def reset(self) -> None:
        """See ``Tracker``."""
        super().reset()
        self._plan = None
        self._solvers.clear()

    def respond(self, response: Response) -> None:
        """See the base class."""
        super().respond(response)
        self._lag, self._fading = self._responses()
        self._layouts.clear()

    def steer(self, state: TrackingState) -> Angles:
        """Return the axle angles for the next period."""
        modes = tuple(state.reference.steerings(state.distances(self._times)))
        modes = (state.steering, *modes[1:])
        layout = self._layout(modes)
        last = layout.onto @ np.array(state.requested)
        fine = state.reference.at(state.distances(self._middles))
        nominal = self._nominal(state, modes, layout.bases)
        rollout = self._roll(state, fine, layout, nominal)
        end = self._end(state, modes[-1], rollout)
        wanted = self._solve(rollout, layout.weights, end, nominal, last)
        self._plan, self._planned = wanted, modes
        front, rear = layout.bases[0] @ wanted[0]
        return float(front), float(rear)

    def _layout(self, modes: tuple[Steering, ...]) -> Layout:
        known = self._layouts.get(modes)
        if known is None:
            if len(self._layouts) >= 64:  # number of kept sequences of steering modes
                self._layouts.clear()
            m = max(BASES[mode].shape[1] for mode in modes)
            padded = {mode: np.pad(BASES[mode], ((0, 0), (0, m - BASES[mode].shape[1]))) for mode in set(modes)}
            bases = np.array([padded[mode] for mode in modes])
            effect = np.einsum("fk,kij->fikj", self._lag, bases).reshape(self._fine, 2, -1)
            known = self._layouts[modes] = Layout(bases, np.linalg.pinv(bases[0]), effect, self._weights(modes))
        return known

    def _nominal(self, state: TrackingState, modes: tuple[Steering, ...], bases: Array) -> Array:
        """Return the linearisation plan (k, m): the last plan shifted by one period, else the path's angles."""
        old = self._plan
        if old is not None and old.shape == (len(modes), bases.shape[2]) and self._planned[1] == modes[0]:
            return np.vstack((old[1:], old[-1:]))
        ahead = state.reference.at(state.distances(self._times))
        asked = np.column_stack(self.geometry.steer_for(ahead.turn, np.clip(ahead.slip, -1.0, 1.0)))
        inputs = np.array([np.linalg.pinv(basis) @ both for basis, both in zip(bases, asked, strict=True)])
        return np.asarray(np.clip(inputs, -self.config.angle, self.config.angle))

    def _responses(self) -> tuple[Array, Array]:
        """Return the axle angle in the middle of each fine step, per request (f, k) and per current angle (f,)."""
        middle = self._middles
        begin = np.arange(self._periods, dtype=np.float64) * self.period
        lag = max(self.response.lag, LEAST_LAG)
        risen = [1.0 - np.exp(-np.maximum(middle[:, None] - b, 0.0) / lag) for b in (begin, begin + self.period)]
        return risen[0] - risen[1], np.asarray(np.exp(-middle / lag))

    def _roll(self, state: TrackingState, reference: ReferenceStates, layout: Layout, plan: Array) -> Rollout:
        angles = self._fading[:, None] * np.array(state.angles) + layout.effect @ plan.ravel()
        tangents = np.tan(np.minimum(np.maximum(angles, -STEEPEST), STEEPEST))
        slopes = 1.0 + tangents**2
        c, base = self.geometry.cg_split, self.geometry.wheelbase
        slip_tangent = (1.0 - c) * tangents[:, 0] + c * tangents[:, 1]
        cosine = 1.0 / np.sqrt(1.0 + slip_tangent**2)
        turn = cosine * (tangents[:, 0] - tangents[:, 1]) / base
        steps = self._h * state.speeds(self._middles)
        errors = self._integrate(state, reference, turn, np.arctan(slip_tangent), steps)
        # One column of axle angles per input, then sums along the path.
        effect = layout.effect * slopes[:, :, None]
        by_step = (steps * cosine / base)[:, None] * (effect[:, 0] - effect[:, 1])
        by_turn = by_step.cumsum(axis=0)
        by_slip = (steps * cosine**2)[:, None] * ((1.0 - c) * effect[:, 0] + c * effect[:, 1])
        by_side = (steps[:, None] * (by_turn - 0.5 * by_step) + by_slip).cumsum(axis=0)
        return Rollout(errors, np.concatenate((by_side, by_turn)))

    def _integrate(
        self, state: TrackingState, reference: ReferenceStates, turn: Array, slip: Array, steps: Array
    ) -> Array:
        """Return the errors along the plan in the path's curved frame; ``steps``: lengths of the fine steps (m)."""
        # Limit of the distance from the path, as a fraction of the distance to be driven.
        furthest = 0.3 * float(state.distances(self._times[-1:])[0] - state.s)
        side, turned = min(max(state.lateral_error, -furthest), furthest), state.heading_error
        bend = state.run.direction * reference.curvature
        sides, yaws = [], []
        rows = np.array((turn, slip - reference.slip, reference.turn, bend, steps)).T.tolist()
        for body_turn, sideways, wanted_turn, curvature, ahead in rows:
            along = math.cos(turned + sideways) / max(1.0 - curvature * side, 0.2)
            gained = ahead * (body_turn - wanted_turn * along)
            side += ahead * math.sin(turned + 0.5 * gained + sideways)
            turned += gained
            sides.append(side)
            yaws.append(turned)
        return np.array(sides + yaws)

    def _weights(self, modes: tuple[Steering, ...]) -> Array:
        """Return the weights of the squared errors, shape (2 f,)."""
        config = self.config
        free = np.repeat([mode == "crab" for mode in modes], self._fine // self._periods)
        heading = np.where(free, 0.0, self._h / config.heading_scale**2)
        return np.concatenate((np.full(self._fine, self._h / config.lateral_scale**2), heading))

    def _end(self, state: TrackingState, mode: Steering, rollout: Rollout) -> Terminal | None:
        """Return the terminal cost after the last period with the axles at their optimum; None for crab."""
        if mode == "crab":
            return None
        least = self._gains.at(mode, float(state.speeds(self._times[-1:])[0]), self.response.lag).least
        ends = slice(self._fine - 1, None, self._fine)
        return Terminal(rollout.errors[ends], rollout.by_plan[ends], least)

    def _solve(self, rollout: Rollout, weights: Array, end: Terminal | None, nominal: Array, last: Array) -> Array:
        """Return the best plan, shape (k, m)."""
        count, m = nominal.shape
        if m not in self._solvers:
            self._solvers[m] = Solver(count, m, self.config, self.period)
        sensitivity = rollout.by_plan
        offset = rollout.errors - sensitivity @ nominal.ravel()
        weighted = sensitivity.T * weights
        quadratic, linear = weighted @ sensitivity, weighted @ offset
        if end is not None:
            weighted = end.by_plan.T @ end.cost
            quadratic += weighted @ end.by_plan
            linear += weighted @ (end.errors - end.by_plan @ nominal.ravel())
        plan = self._solvers[m].solve(quadratic, linear, last)
        return nominal if plan is None else plan.reshape(count, m)


class Solver:
    """Solver of a quadratic programme of fixed size: limited inputs and input changes between periods.

    Args:
        count: number of periods.
        m: inputs per period.
        config: limits and the weight of changes.
        period: period (s).
    """

    def __init__(self, count: int, m: int, config: MpcConfig, period: float) -> None:
        n = count * m
        self._change = np.eye(n) - np.eye(n, k=-m)
        weight = 1.0 / (period * config.rate_scale**2)
        # Weight that keeps inputs without effect unchanged.
        self._smooth = weight * self._change.T @ self._change + 1e-6 * np.eye(n)
        self._pull = weight
        self._m = m
        self._most = np.concatenate((np.full(n, config.angle), np.full(n, config.steering_rate * period)))
        self._iterations = config.iterations

    def solve(self, quadratic: Array, linear: Array, last: Array) -> Array | None:
        """Minimise x'Qx/2 + l'x + changes starting from ``last``; None if the solver found no solution."""
        n = len(linear)
        q = linear.copy()
        q[: self._m] -= self._pull * last
        low, high = -self._most, self._most.copy()
        first = slice(n, n + self._m)
        low[first] += last
        high[first] += last
        plan, _, outcome, _ = daqp.solve(
            quadratic + self._smooth, q, self._change, high, low, iter_limit=self._iterations
        )
        return np.asarray(plan) if outcome == 1 and np.isfinite(plan).all() else None  # outcome of DAQP: the solution
