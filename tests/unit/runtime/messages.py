"""One strategy per model, so that every topic's round trip is tested with the same care."""

from typing import Any, get_args

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from monstertruck_schemas import topics as t
from monstertruck_schemas.base import Message, Pose2D, Twist2D
from monstertruck_schemas.event import Cause, LogLevel, LogRecord, Measurement
from monstertruck_schemas.plan import Path, Steering
from monstertruck_schemas.sensor import CompressedImage, LaserScan, SonarEcho, StabiliserJoint, TorqueState, Vector3
from monstertruck_schemas.state import Grid, Ground, Odometry, Transform, Transforms

ns = st.integers(-(2**63), 2**63 - 1)
number = st.floats(allow_nan=False, allow_infinity=False)
positive = st.floats(min_value=0, exclude_min=True, allow_infinity=False)
frame = st.from_regex(r"\A[a-z][a-z0-9_]{0,10}\Z")
header: dict[str, Any] = {"stamp": ns, "received": ns, "seq": st.integers(0, 2**63 - 1), "frame": frame}
poses = st.builds(Pose2D, x=number, y=number, yaw=number)
vectors = st.builds(Vector3, x=number, y=number, z=number)

joints = st.builds(
    StabiliserJoint,
    torque=st.sampled_from(TorqueState),
    error=st.integers(0, 255),
    velocity=st.none() | number,
    load=st.none() | number,
    voltage=st.none() | number,
    temperature=st.none() | number,
)

causes = st.builds(
    Cause,
    since=ns,
    measurements=st.lists(
        st.builds(
            Measurement,
            name=st.text(),
            value=st.none() | number,
            unit=st.text(max_size=3),
            limit=st.none() | number,
            age=st.none() | number,
        ),
        max_size=2,
    ).map(tuple),
    because=st.none() | st.integers(0, 9),
)


def doubles(n: int | st.SearchStrategy[int]) -> st.SearchStrategy[Any]:
    return hnp.arrays(np.float64, n, elements=st.floats(allow_nan=False))


scans = st.integers(0, 20).flatmap(
    lambda n: st.builds(
        LaserScan,
        **header,
        start_angle=number,
        end_angle=number,
        time_increment=st.floats(0, 1),
        scan_time=positive,
        range_min=st.floats(0, 1),
        range_max=positive,
        ranges=doubles(n),
        codes=hnp.arrays(np.uint8, n),
        intensities=st.none() | hnp.arrays(np.uint8, n) if n else st.none(),
        tilt=st.none() | st.floats(0, 2),
        range_noise=st.none() | st.floats(0, 0.1),
    )
)
echoes = st.lists(
    st.builds(SonarEcho, name=frame, answered=st.booleans(), range=st.none() | positive, stamp=ns), max_size=3
).map(tuple)
images = st.builds(CompressedImage, **header, data=st.binary(max_size=300), sequence=st.integers(0, 2**32 - 1))
odometries = st.builds(
    Odometry,
    **header,
    child=frame,
    pose=poses,
    twist=st.builds(Twist2D, vx=number, vy=number, wz=number),
    pose_covariance=doubles(9),
    twist_covariance=doubles(9),
    age=st.floats(0, 1e6),
    sources=st.lists(st.text(), max_size=3).map(tuple),
)
paths = st.builds(
    Path,
    **header,
    poses=hnp.arrays(np.float64, st.integers(0, 5).map(lambda n: 3 * n), elements=number),
    directions=doubles(st.integers(0, 5)),
    steering=st.lists(st.sampled_from(get_args(Steering)), max_size=5).map(tuple),
    clearance=doubles(st.integers(0, 5)),
    speeds=doubles(st.integers(0, 5)),
    closed=st.booleans(),
    halts=st.booleans(),
    name=st.text(),
)
grids = st.tuples(st.integers(1, 5), st.integers(1, 5)).flatmap(
    lambda size: st.builds(
        Grid,
        **header,
        resolution=positive,
        width=st.just(size[0]),
        height=st.just(size[1]),
        origin=poses,
        cells=hnp.arrays(np.int8, size[0] * size[1], elements=st.integers(-1, 100)),
    )
)
grounds = st.tuples(st.integers(1, 5), st.integers(1, 5)).flatmap(
    lambda size: st.builds(
        Ground,
        **header,
        resolution=positive,
        width=st.just(size[0]),
        height=st.just(size[1]),
        origin=poses,
        tilt=hnp.arrays(np.uint8, size[0] * size[1]),
        roughness=hnp.arrays(np.uint8, size[0] * size[1]),
    )
)
trees = st.builds(
    Transforms,
    **header,
    transforms=st.lists(
        st.builds(
            Transform,
            parent=frame,
            child=frame,
            stamp=ns,
            translation=st.tuples(number, number, number),
            rotation=st.tuples(number, number, number, number),
        ),
        max_size=3,
    ).map(tuple),
)

PROTOBUF: dict[t.Topic[Any], st.SearchStrategy[Message]] = {
    t.SCAN: scans,
    t.SCAN_2: scans,
    t.CAMERA: images,
    t.ODOMETRY: odometries,
    t.POSE: odometries,
    t.PATH: paths,
    t.MAP: grids,
    t.MAP_TILES: grids,
    t.SEEN: grids,
    t.GROUND: grounds,
    t.TRANSFORMS: trees,
    t.LOG: st.builds(LogRecord, **header, level=st.sampled_from(LogLevel), line=st.integers(0, 2**32 - 1)),
}


FIELDS: dict[t.Topic[Any], dict[str, Any]] = {
    t.REQ_GOAL: {"goal": poses},
    t.COMPASS: {"magnetic_field": st.none() | vectors, "acceleration": st.none() | vectors},
    t.SONAR: {"sonars": echoes},
    t.STAND_POSE: {"pose": poses},
    t.IMU: {"angular_velocity": vectors, "linear_acceleration": vectors},
    t.HAND: {"speed": st.floats(-1, 1), "steer": st.floats(-1, 1), "link_quality": st.none() | st.floats(0, 1)},
    t.STABILISER: {"pitch_joint": joints, "roll_joint": joints},
    t.EVENT: {
        "values": st.dictionaries(
            st.text(), st.none() | st.booleans() | st.integers(-(2**40), 2**40) | number | st.text(), max_size=3
        )
    },
    t.REQ_LOCALISATION: {"correction": poses},
    t.REQ_MAP: {"origin": poses, "packed": st.binary(max_size=64)},
    t.SLAM: {"overlap": st.floats(0, 1)},
    t.SCAN_MOTION: {"motion": poses, "covariance": hnp.arrays(np.float64, 9, elements=number)},
    t.STOP: {"number": st.integers(1, 2**40), "causes": st.lists(causes, min_size=1, max_size=3).map(tuple)},
}
"""Strategies of fields that any value of their type would not do for."""


def of(topic: t.Topic[Any]) -> st.SearchStrategy[Message]:
    """Messages of any topic."""
    if topic in PROTOBUF:
        return PROTOBUF[topic]
    if topic is t.REQ_PATH:
        return st.builds(topic.model, **header, path=paths, lease=st.floats(0.01, 2), source=st.just("tester"))
    special: dict[str, Any] = {"frame": frame}
    for name, field in topic.model.model_fields.items():
        if field.annotation in (float, float | None):
            finite = number if field.annotation is float else st.none() | number
            special[name] = finite.map(lambda x: None if x is None else abs(x) % 2.0 or 1.0)
    if "source" in topic.model.model_fields and topic.group != "event":
        special["source"] = st.from_regex(r"\A[A-Za-z0-9_.@:-]{1,64}\Z")
    return st.builds(topic.model, **special | FIELDS.get(topic, {}))
