"""Model of the truck's turns as a function of the servo pulses, fitted by the steering wizard.

Both axles are steered, so a turn depends only on the difference between their angles:
wz = v_x (tan front - tan rear) / L. Arcs with one axle at a time determine the gain of each axle; straight runs
determine the difference between their centres. Equal errors in both centres make the truck crab without turning, which
the compass cannot see. They appear as a sideways offset from a string and, if the linkage model is correct, as a small
difference between circles to the left and to the right.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass, field, replace
from typing import Final, Literal

import numpy as np

from monstertruck_kinematics.chassis import TruckChassis
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.fitting import FitResult, least_squares
from monstertruck_kinematics.polynomials import SERVO_LIMIT
from monstertruck_kinematics.truck import LinkedAxles, TurnDeficit
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.body import TruckBody
from monstertruckd.config.truck import TruckConfig
from monstertruckd.tools.calibrate.assumed import ASSUMED
from monstertruckd.tools.calibrate.statistics import NORMAL, student
from monstertruckd.tools.calibrate.steps import MoveRecord

Axle = Literal["front", "rear"]
AXLES: Final[tuple[Axle, Axle]] = ("front", "rear")

EYE: Final = math.radians(3.0)
"""Maximum servo angle of wheels that look straight, rad: without a string the only bound on a common error."""


@dataclass(frozen=True, slots=True)
class Maps:
    """Pulse maps of both servos: pulse = centre + scale * servo angle in degrees.

    The sign of the scale is the direction.
    """

    centres: tuple[float, float]
    """Centres, front and rear, us."""
    scales: tuple[float, float]
    """Scales, front and rear, us per degree."""
    deficit: TurnDeficit = field(default_factory=TurnDeficit)
    """Shortfall of the turn compared with the linkage."""

    @classmethod
    def of(cls, config: TruckConfig) -> "Maps":
        """Create maps from the configuration.

        Raises:
            InputError: the truck has no steering.
        """
        steering = config.devices.steering
        if steering is None:
            raise InputError("devices.steering: not in this robot's configuration, so there is nothing to calibrate")
        servos = (steering.driver.front, steering.driver.rear)
        front, rear = servos
        deficit = config.body.turn_deficit.model_dump() if isinstance(config.body, TruckBody) else {}
        return cls(
            (front.centre_us, rear.centre_us),
            (front.direction * front.scale_us_per_deg, rear.direction * rear.scale_us_per_deg),
            TurnDeficit(**deficit),
        )

    @classmethod
    def from_parameters(cls, parameters: Array) -> "Maps":
        """Create maps from (front centre, front scale, rear centre, rear scale) and the fields of the deficit."""
        front, front_scale, rear, rear_scale, *deficit = (float(value) for value in parameters)
        return cls((front, rear), (front_scale, rear_scale), TurnDeficit(*deficit))

    @property
    def parameters(self) -> Array:
        """Parameter vector, shape (10,); see ``from_parameters``."""
        pulses = self.centres[0], self.scales[0], self.centres[1], self.scales[1]
        return np.array((*pulses, *astuple(self.deficit)))

    def pulses(self, axle: int, servo: Array) -> Array:
        """Pulses that the daemon sends for servo angles in rad (us)."""
        return np.asarray(self.centres[axle] + self.scales[axle] * np.degrees(servo))

    def servo(self, axle: int, pulses: Array) -> Array:
        """Servo angles for the given pulses (rad), limited to the range of the linkage."""
        angles = np.radians((pulses - self.centres[axle]) / self.scales[axle])
        return np.asarray(np.clip(angles, -SERVO_LIMIT, SERVO_LIMIT))


@dataclass(frozen=True, slots=True)
class SteeringRun:
    """One move, prepared for the fit."""

    motor: Array
    """Motor rotation between readings, rad; (n,)."""
    pulses: tuple[Array, Array]
    """Pulses of the front and rear servo at that time, us; (n,) each."""
    turn: float
    """Turn measured between the rests, rad, left positive."""
    sigma: float
    """Standard deviation of ``turn``, rad."""
    offset: float | None = None
    """Offset from the string at the end, m, left positive; None if not measured."""
    offset_sigma: float = 0.01

    @classmethod
    def of(
        cls, track: MoveRecord, maps: Maps, offset: float | None = None, offset_sigma: float = 0.01
    ) -> "SteeringRun":
        """Create a run from a move driven with the daemon's maps."""
        motor, *servos = track.steps()
        turn, noise = track.turn()
        part = abs(math.remainder(turn, 2 * math.pi))
        sigma = math.hypot(
            ASSUMED.turn_heading, noise, ASSUMED.turn_compass * min(part, 1.0), ASSUMED.turn_linkage * turn
        )
        pulses = maps.pulses(0, servos[0]), maps.pulses(1, servos[1])
        return cls(motor, pulses, turn, sigma, offset, offset_sigma)


class SteeringModel:
    """Kinematic model of the truck for the fit.

    Args:
        chassis: linkage, wheelbase, drive.
    """

    def __init__(self, chassis: TruckChassis) -> None:
        assert isinstance(chassis.linkage, LinkedAxles)
        self.chassis = chassis
        self._linkage = chassis.linkage

    def axles(self, maps: Maps) -> LinkedAxles:
        """Return the linkage with the turn deficit of ``maps``."""
        return replace(self._linkage, deficit=maps.deficit)

    def axle_angle(self, axle: int, servo: float, maps: Maps) -> float:
        """Angle of an axle (rad) at its servo angle while the other axle is straight."""
        return self.axles(maps).angles(*((servo, 0.0) if axle == 0 else (0.0, servo)))[axle]

    def commands(self, servos: Sequence[float], true: Maps, configured: Maps) -> tuple[float, float]:
        """Axle angles (rad) that make a daemon with ``configured`` maps reach the true servo angles (rad)."""
        front, rear = (float(configured.servo(i, true.pulses(i, np.array(servo)))) for i, servo in enumerate(servos))
        return self.axles(configured).angles(front, rear)

    def predict(self, legs: Sequence[SteeringRun], maps: Maps) -> tuple[Array, Array]:
        """Predict turns (rad) and sideways offsets (m) of legs, left positive; (n,) each."""
        sizes = [leg.motor.size for leg in legs]
        starts = list(itertools.accumulate(sizes[:-1], initial=0))
        motor = np.concatenate([leg.motor for leg in legs])
        servos = (maps.servo(axle, np.concatenate([leg.pulses[axle] for leg in legs])) for axle in (0, 1))
        front, rear = self.axles(maps).angles(*servos)
        bicycle = self.chassis.bicycle
        rolled = self.chassis.drivetrain.distance(motor) / bicycle.drive_speed(np.ones_like(front), front, rear)
        forward, sideways, turned = bicycle.body_twist(rolled, front, rear)
        turns = np.add.reduceat(turned, starts)
        heading = np.cumsum(turned) - turned / 2 - np.repeat(np.cumsum(turns) - turns, sizes)
        return turns, np.add.reduceat(forward * np.sin(heading) + sideways * np.cos(heading), starts)

    def distance(self, leg: SteeringRun) -> float:
        """Distance travelled on a leg (m)."""
        return float(np.abs(self.chassis.drivetrain.distance(leg.motor)).sum())

    # 0.15: maximum relative difference between a pulse map and the configured one before the measurement
    def fit(self, legs: Sequence[SteeringRun], start: Maps, gain: float = 0.15) -> FitResult:
        """Fit the pulse maps to all legs; for the parameters see ``Maps.parameters``.

        Args:
            legs: driven legs.
            start: initial guess, with correct directions.
            gain: relative prior uncertainty of the scales.
        """
        guess = start.parameters
        sigmas = np.array([ASSUMED.turn_of_leg(leg.sigma, self.distance(leg)) for leg in legs])
        turns = np.array([leg.turn for leg in legs])
        strings = [(k, leg.offset, leg.offset_sigma) for k, leg in enumerate(legs) if leg.offset is not None]

        def residual(parameters: Array) -> Array:
            turned, aside = self.predict(legs, Maps.from_parameters(parameters))
            off = np.radians((parameters[[0, 2]] - guess[[0, 2]]) / guess[[1, 3]])
            # 0.3: standard deviation of a coefficient of the turn deficit before the measurement: 5 % of the turn at
            # full lock
            return np.array(
                (
                    *((turned - turns) / sigmas),
                    *((aside[k] - offset) / sigma for k, offset, sigma in strings),
                    off.sum() / (math.sqrt(2) * EYE),
                    *((parameters[[1, 3]] / guess[[1, 3]] - 1) / gain),
                    *(parameters[4:] / 0.3),
                )
            )

        spread = np.array((150.0, 0.5 * abs(guess[1]), 150.0, 0.5 * abs(guess[3]), *(np.inf,) * (guess.size - 4)))
        return least_squares(residual, guess, guess - spread, guess + spread)

    def reached(self, leg: SteeringRun, maps: Maps, axle: int) -> tuple[float, float]:
        """Return an axle's true servo angle on a leg, computed from the turn, and the angle its pulses command (rad).

        The other axle is assumed to follow the maps. Valid for a leg with constant steering.
        """
        axles = self.axles(maps)
        bicycle, sense = self.chassis.bicycle, 1.0 if axle == 0 else -1.0
        rolled = float(self.chassis.drivetrain.distance(leg.motor.sum()))
        meant = [float(maps.servo(i, leg.pulses[i]).mean()) for i in (0, 1)]

        def turned(servo: float) -> float:
            angles = axles.angles(*((servo, meant[1]) if axle == 0 else (meant[0], servo)))
            return bicycle.body_twist(rolled / bicycle.drive_speed(1.0, *angles), *angles)[2]

        low, high = -SERVO_LIMIT, SERVO_LIMIT
        for _ in range(40):
            middle = 0.5 * (low + high)
            more = sense * (leg.turn - turned(middle)) * math.copysign(1.0, rolled) > 0.0
            low, high = (middle, high) if more else (low, middle)
        return low, meant[axle]


def half_widths(fit: FitResult, priors: int = 9) -> Array:
    """Half-widths of the parameters' 95 % intervals.

    The errors of a leg are known in advance; if the legs disagree by more, their spread is used.

    Args:
        fit: result of ``SteeringModel.fit``.
        priors: number of residuals that are priors, not measurements.
    """
    freedom = fit.residuals.size - priors - fit.parameters.size
    spread = math.sqrt(float(np.sum(fit.residuals**2)) / max(1, fit.residuals.size - fit.parameters.size))
    if spread <= 1.0 or freedom < 1:
        return np.asarray(NORMAL * fit.standard_errors / min(spread, 1.0))
    return np.asarray(student(freedom) * fit.standard_errors)
