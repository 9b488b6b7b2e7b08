"""Inputs and outputs of steps as JSON, exactly, for another machine: only the classes listed here are ever built."""

import base64
import dataclasses
from enum import Enum
from pathlib import Path as FilePath
from typing import Any, Final

import numpy as np

from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.collision import Footprint
from monstertruck_planners.goals.config import EscapeConfig, LocalConfig, PlannerConfig
from monstertruck_planners.goals.exchange import DeformAnswer, DeformTask, PlanAnswer, PlanTask, Setup, Way
from monstertruck_planners.local.config import BandConfig, PublishedConfig, RsbandConfig, TebConfig
from monstertruck_planners.route.config import HybridConfig, LatticeConfig
from monstertruck_planners.track.config import (
    FuzzyConfig,
    LqrConfig,
    MpcConfig,
    PurePursuitConfig,
    StanleyConfig,
)
from monstertruck_planners.track.step import Told, TrackInput, TrackOutput, TrackSetup
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.base import Pose2D, Schema, Twist2D
from monstertruck_schemas.event import Severity
from monstertruck_schemas.plan import Path, TrackerState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveRequest, Role
from monstertruck_schemas.sensor import Attitude, LaserScan, Vector3
from monstertruck_schemas.state import GateMode, GateState, Grid, Odometry

_CLASSES: Final[dict[str, type[Any]]] = {
    cls.__name__: cls
    for cls in (
        *(PlanTask, PlanAnswer, Setup, PlannerConfig, EscapeConfig, HybridConfig, LatticeConfig, Grid, Pose2D),
        *(DeformTask, DeformAnswer, Way, LocalConfig, RsbandConfig, PublishedConfig, TebConfig, BandConfig),
        *(TrackInput, TrackOutput, TrackSetup, Told, Odometry, Twist2D, Path, GateState, LaserScan, Attitude, Vector3),
        *(DriveRequest, TrackerState, FuzzyConfig, LqrConfig, MpcConfig, PurePursuitConfig, StanleyConfig),
        *(FourWheelSteering, Footprint),
    )
}
_ENUMS: Final[dict[str, type[Enum]]] = {cls.__name__: cls for cls in (Reason, Severity, Role, GateMode)}
_DTYPES: Final = ("float64", "int8", "uint8", "int64")


def to_json(value: Any) -> Any:
    """A tree of known classes, arrays, tuples, lists, dicts by text, and scalars as what JSON can say.

    Raises:
        InputError: something else.
    """
    match value:
        case Enum() if type(value).__name__ in _ENUMS:
            return {"enum": type(value).__name__, "value": value.value}
        case None | bool() | int() | float() | str():
            return value
        case np.ndarray() if str(value.dtype) in _DTYPES:
            data = base64.b64encode(np.ascontiguousarray(value).tobytes()).decode()
            return {"array": str(value.dtype), "shape": list(value.shape), "data": data}
        case FilePath():
            return {"path": str(value)}
        case tuple():
            return {"tuple": [to_json(inner) for inner in value]}
        case list():
            return [to_json(inner) for inner in value]
        case dict():
            return {"dict": [[key, to_json(inner)] for key, inner in value.items()]}
    name = type(value).__name__
    if _CLASSES.get(name) is not type(value):
        raise InputError(f"step: no {name} travels to another machine")
    names = type(value).model_fields if isinstance(value, Schema) else [f.name for f in dataclasses.fields(value)]
    return {"class": name, "fields": {field: to_json(getattr(value, field)) for field in names}}


def from_json(value: Any) -> Any:
    """Back.

    Raises:
        InputError: nothing that ``to_json`` makes.
    """
    try:
        return _back(value)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"step: not readable: {type(error).__name__}: {error}") from error


def _back(value: Any) -> Any:
    match value:
        case {"enum": name, "value": inner}:
            return _ENUMS[name](inner)
        case {"array": dtype, "shape": shape, "data": data} if dtype in _DTYPES:
            return np.frombuffer(base64.b64decode(data, validate=True), dtype).reshape(shape)
        case {"path": text}:
            return FilePath(text)
        case {"tuple": inner}:
            return tuple(map(_back, inner))
        case {"dict": rows}:
            return {key: _back(inner) for key, inner in rows}
        case {"class": name, "fields": fields}:
            return _CLASSES[name](**{field: _back(inner) for field, inner in fields.items()})
        case list():
            return [_back(inner) for inner in value]
        case None | bool() | int() | float() | str():
            return value
    raise ValueError(f"unknown object {str(value)[:64]}")
