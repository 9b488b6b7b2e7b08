"""Drive families by name, so that a configuration can choose one."""

import inspect
from collections.abc import Callable

from monstertruck_kinematics.drive import Drive
from monstertruck_kinematics.elementary import KinematicsError
from monstertruck_kinematics.steered import Ackermann, Bicycle, FourWheelSteer, IndependentSteer, Synchro, Tricycle
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_kinematics.unsteered import Differential, SkidSteer, mecanum, omni


def _four_wheel_steer(
    wheelbase: float = 0.32,
    track: float = 0.26,
    cg_split: float = 0.5,
    radius: float = 0.075,
) -> Drive:
    return FourWheelSteer(FourWheelSteering(wheelbase, track, cg_split), radius)


def _independent_steer(wheelbase: float = 0.32, track: float = 0.26, radius: float = 0.075) -> Drive:
    return IndependentSteer(FourWheelSteering(wheelbase, track).wheel_positions, radius)


def _skid_steer(
    radius: float = 0.021,
    half_track: float = 0.0525,
    icr_x: float = 0.0,
    front: float = 0.0305,
    rear: float = 0.0305,
    gain_left: float = 1.0,
    gain_right: float = 1.0,
) -> Drive:
    return SkidSteer(radius, half_track, -half_track, icr_x, gain_left, gain_right, front, rear)


FAMILIES: dict[str, Callable[..., Drive]] = {
    "truck": _four_wheel_steer,
    "ackermann": Ackermann,
    "bicycle": Bicycle,
    "differential": Differential,
    "independent": _independent_steer,
    "mecanum": mecanum,
    "omni": omni,
    "skid_steer": _skid_steer,
    "synchro": Synchro,
    "tricycle": Tricycle,
}
"""Kind -> builder; every parameter has a default and a name."""


def parameters_of(kind: str) -> dict[str, object]:
    """Names and defaults of a family's parameters.

    Raises:
        KinematicsError: no such family.
    """
    if kind not in FAMILIES:
        raise KinematicsError(f"family {kind!r}: expected one of {', '.join(FAMILIES)}")
    return {name: p.default for name, p in inspect.signature(FAMILIES[kind]).parameters.items()}


def build_drive(kind: str, **parameters: float | str) -> Drive:
    """A drive family with some of its parameters set.

    Raises:
        KinematicsError: no such family or parameter, a value of the wrong type, or one no robot can have.
    """
    known = parameters_of(kind)
    for name, value in parameters.items():
        if name not in known:
            raise KinematicsError(f"{kind}: no parameter {name}: expected one of {', '.join(known)}")
        if isinstance(value, str) != isinstance(known[name], str):
            raise KinematicsError(f"{kind}: {name} is {value!r}: expected something like {known[name]!r}")
    return FAMILIES[kind](**parameters)
