"""Processor time of a step of ``mpc``, against the same programme by CasADi's SQP method with OSQP.

Both are trackers on the reference model of the part tracking, with the same base class, model, costs, limits and
horizon; each drives every course, in turns. ``programme`` is the time of ours including its preparation from the path,
and of the peer the call of the solver alone. The peer takes one Gauss-Newton iteration per step from its last plan, as
ours does; its functions are built beforehand. All rounds take the same steps, and the least time of a step counts:
additional time is due to other load.
"""

import math
import operator
import time
from functools import partial
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from benchmarks.navigation_parts import Options, Part
from benchmarks.navigation_parts.tracking import built_in, drive, from_data
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.track.config import MpcConfig
from monstertruck_planners.track.error_model import LEAST_LAG
from monstertruck_planners.track.lqr import GainTable
from monstertruck_planners.track.mpc import Mpc
from monstertruck_planners.track.path_tracker import Angles, PathTracker, TrackingState

GENTLE = 1e-6
APPROACH = 0.3

FINE = 0.05
MOST_PERIODS = 30

SPEEDS, AXLES = (0.5, 1.0), ("ideal", "lag")
ROUNDS = 5
SKIPPED = 3
"""First steps of a run that are left out: gains of a new speed, caches."""


def run(options: Options) -> Part:
    courses = built_in() if options.data is None else from_data(options)
    builders = {"ours": Mpc, "casadi": CasadiMpc}
    steps: dict[str, list[list[np.ndarray]]] = {name: [] for name in builders}
    programmes: dict[str, list[float]] = {name: [] for name in builders}
    errors: dict[str, list[float]] = {name: [] for name in builders}
    for _ in range(3 if options.quick else ROUNDS):
        for rounds in steps.values():
            rounds.append([])
        for points in courses.values():
            for speed in SPEEDS:
                for axles in AXLES:
                    for name, build in builders.items():
                        call = partial(watched, build, programmes[name])
                        found = drive(points, "mpc", speed, axles, "forward", build=call)
                        steps[name][-1].append(found.steps_ms[SKIPPED:])
                        errors[name].append(found.rms)
    part = Part()
    for name in builders:
        all_steps = np.min([np.concatenate(runs) for runs in steps[name]], axis=0)
        median, p99 = float(np.median(all_steps)), float(np.quantile(all_steps, 0.99))
        part.add(f"{name}_median_ms", median)
        part.add(f"{name}_p99_ms", p99)
        part.add(f"{name}_programme_median_ms", float(np.median(programmes[name])))
        part.add(f"{name}_rms_max_mm", max(errors[name]))
        alone = f"programme alone {part.figures[f'{name}_programme_median_ms']:.3f} ms"
        what = f"median {median:.3f} ms, p99 {p99:.3f} ms of {len(all_steps)} steps"
        print(f"{name}: {what}; {alone}; RMS at most {max(errors[name]):.1f} mm")
    part.add("over_casadi", part.figures["ours_median_ms"] / part.figures["casadi_median_ms"], 1.0)
    programme = (part.figures[f"{name}_programme_median_ms"] for name in builders)
    part.add("programme_over_casadi", operator.truediv(*programme), 1.0)
    part.add("p99_over_median", part.figures["ours_p99_ms"] / part.figures["ours_median_ms"], 2.0)
    return part


def watched(build: type[PathTracker[MpcConfig]], times: list[float], config: Any, geometry: Any) -> PathTracker[Any]:
    """Return a tracker that records the time of its programme in ``times``, ms; of the peer the solver call alone."""
    tracker: Any = build(config, geometry)
    name = "solver" if build is CasadiMpc else "steer"
    call = getattr(tracker, name)

    def timed(*values: Any, **more: Any) -> Any:
        begin = time.thread_time()
        result = call(*values, **more)
        times.append(1000 * (time.thread_time() - begin))
        return result

    setattr(tracker, name, timed)
    return tracker


class CasadiMpc(PathTracker[MpcConfig]):
    """The peer, for front steering."""

    def __init__(self, config: MpcConfig, geometry: FourWheelSteering) -> None:
        super().__init__(config, geometry)
        self._periods = min(max(math.ceil(config.preview * config.rate), 2), MOST_PERIODS)
        self._per = max(math.ceil(self.period / FINE - 1e-9), 1)
        self._h = self.period / self._per
        self._middles: NDArray[np.float64] = (np.arange(self._periods * self._per) + 0.5) * self._h
        self._gains = GainTable(config, geometry, 1)
        self._plan = np.zeros(self._periods)
        self._multipliers = np.zeros(self._periods), np.zeros(self._periods)
        self.solver = self._programme()
        n = self._periods
        most = config.steering_rate * self.period
        self._limits = {"lbx": -config.angle, "ubx": config.angle, "lbg": [-most] * n, "ubg": [most] * n}

    def _programme(self) -> ca.Function:
        n, config, geometry = self._periods, self.config, self.geometry
        fine = n * self._per
        plan = ca.SX.sym("plan", n)
        state = ca.SX.sym("state", 4)  # distance and yaw error, axle angle, last request
        path = ca.SX.sym("path", fine, 5)  # reference slip, yaw and turn, bend, way
        root = ca.SX.sym("root", 2, 2)  # of the cost after the last period
        side, turned, angle = state[0], state[1], state[2]
        lag = max(self.response.lag, LEAST_LAG)
        half, whole = (math.exp(-share * self._h / lag) for share in (0.5, 1.0))
        weights = math.sqrt(self._h) / config.lateral_scale, math.sqrt(self._h) / config.heading_scale
        residuals = []
        for k in range(fine):
            asked = plan[k // self._per]
            tangent = ca.tan(asked + (angle - asked) * half)
            angle = asked + (angle - asked) * whole
            slip_tangent = (1.0 - geometry.cg_split) * tangent
            slip = ca.atan(slip_tangent)
            turn = tangent / ca.sqrt(1.0 + slip_tangent**2) / geometry.wheelbase
            beside = slip - path[k, 0]
            along = ca.cos(turned + beside) / ca.fmax(1.0 - path[k, 3] * side, 0.2)
            gained = path[k, 4] * (turn - path[k, 2] * along)
            side += path[k, 4] * ca.sin(turned + 0.5 * gained + beside)
            turned += gained
            residuals += [weights[0] * side, weights[1] * turned]
        changes = plan - ca.vertcat(state[3], plan[:-1])
        smooth = changes / math.sqrt(self.period) / config.rate_scale
        error = ca.vertcat(*residuals, root @ ca.vertcat(side, turned), smooth, math.sqrt(GENTLE) * plan)
        given = ca.vertcat(state, ca.vec(path), ca.vec(root))
        slope = ca.jacobian(error, plan)
        none = [ca.SX.sym("lam_f"), ca.SX.sym("lam_g", n)]
        hessian = ca.Function("hess_lag", [plan, given, *none], [slope.T @ slope])
        options = {
            "qpsol": "osqp", "qpsol_options": {"osqp": {"verbose": False, "eps_abs": 1e-4, "eps_rel": 1e-4}},
            "hess_lag": hessian, "max_iter": 1, "max_iter_ls": 0, "print_header": False, "print_iteration": False,
            "print_status": False, "print_time": False, "error_on_fail": False,
        }  # fmt: skip
        programme = {"x": plan, "p": given, "f": 0.5 * ca.sumsqr(error), "g": changes}
        return ca.nlpsol("mpc", "sqpmethod", programme, options)

    def steer(self, state: TrackingState) -> Angles:
        """Return the axle angles for the next period."""
        fine = state.reference.at(state.distances(self._middles))
        furthest = APPROACH * float(state.distances(self._middles[-1:])[0] - state.s)
        speeds = state.speeds(self._middles)
        path = (fine.slip, fine.heading, fine.turn, state.run.direction * fine.curvature, self._h * speeds)
        least = self._gains.at("front", float(speeds[-1]), self.response.lag).least
        side = min(max(state.lateral_error, -furthest), furthest)
        given = np.concatenate(
            (
                (side, state.heading_error, state.angles[0], self.axles.requested[0]),
                *path,
                np.linalg.cholesky(least).ravel(),
            )
        )
        found = self.solver(
            x0=self._plan, p=given, lam_x0=self._multipliers[0], lam_g0=self._multipliers[1], **self._limits
        )
        wanted = found["x"].full().ravel()
        self._plan = np.append(wanted[1:], wanted[-1])
        self._multipliers = found["lam_x"], found["lam_g"]
        return float(wanted[0]), 0.0
