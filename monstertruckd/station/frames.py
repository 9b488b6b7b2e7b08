"""Frames for browsers: small messages as JSON text, bulky ones as binary frames.

A text frame is one object with its ``kind`` and, for a message, its fields under ``m``. A binary frame consists of the
length of its head (uint32, little-endian), the head (JSON, with the ``kind``), and the payload.
"""

import json
import struct
import zlib
from pathlib import PurePath
from typing import Any

import numpy as np

from monstertruck_runtime.errors import RequestRefusedError, TruckError
from monstertruck_runtime.plain import plain
from monstertruck_schemas.base import Message
from monstertruck_schemas.plan import Path
from monstertruck_schemas.sensor import CompressedImage, LaserScan
from monstertruck_schemas.state import Grid, Ground, Odometry, Transforms

Frame = str | bytes


def text(kind: str, **fields: Any) -> str:
    """Return a text frame."""
    return _json({"kind": kind, **fields})


def _json(fields: dict[str, Any]) -> str:
    """Return ``fields`` as JSON; a non-finite value, possible in a damaged log, becomes null."""
    try:
        return json.dumps(fields, separators=(",", ":"), allow_nan=False)
    except ValueError:
        return json.dumps(plain(fields), separators=(",", ":"), allow_nan=False)


def message(kind: str, of: Message) -> str:
    """Return a text frame with all fields of a message."""
    return f'{{"kind":"{kind}","m":{of.model_dump_json()}}}'


def binary(kind: str, payload: bytes, **fields: Any) -> bytes:
    """Return a binary frame."""
    head = _json({"kind": kind, **fields}).encode()
    return struct.pack("<I", len(head)) + head + payload


def refusal(number: int, error: TruckError) -> str:
    """Return the answer to a refused command."""
    reason = error.refusal if isinstance(error, RequestRefusedError) else error.reason
    return text("answer", id=number, ok=False, reason=reason.value, text=str(error))


def scan(of: LaserScan, kind: str = "scan") -> bytes:
    """Return a scan from the lidar that ``kind`` names; payload: uint16 ranges in mm, little-endian, 0 = no range."""
    # 65.0: maximum range (m), because ranges are sent as millimetres in 16 bits
    ranges = np.where(np.isfinite(of.ranges) & (of.ranges < 65.0), of.ranges * 1000.0, 0.0)
    return binary(
        kind,
        np.rint(ranges).astype("<u2").tobytes(),
        stamp=of.stamp,
        frame=of.frame,
        start=of.start_angle,
        step=of.angle_increment,
        time_step=of.time_increment,
        tilt=of.tilt,
    )


def picture(of: CompressedImage) -> bytes:
    """Return a camera image; payload: the JPEG file."""
    return binary("camera", of.data, sequence=of.sequence, stamp=of.stamp)


def pose(of: Odometry) -> str:
    """Return pose and velocity, rounded to 0.1 mm and 0.1 mrad."""
    return text(
        "pose",
        frame=of.frame,
        stamp=of.stamp,
        age=round(of.age, 3),
        pose=_rounded(of.pose.x, of.pose.y, of.pose.yaw),
        twist=_rounded(of.twist.vx, of.twist.vy, of.twist.wz),
    )


def path(of: Path) -> str:
    """Return a path, rounded like a pose."""
    return text(
        "path", frame=of.frame, name=of.name, poses=np.round(of.poses, 4).tolist(), directions=of.directions.tolist()
    )


def transforms(of: Transforms) -> str:
    """Return the frame tree."""
    return text(
        "transforms",
        tree={row.child: [row.parent, *row.translation, *row.rotation] for row in of.transforms},
    )


def facts(config: dict[str, Any], versions: dict[str, str]) -> str:
    """Return a robot's type and capabilities, from its configuration, and its software versions."""
    devices = {role: row for role, row in config.get("devices", {}).items() if row is not None}
    return text(
        "facts",
        robot=config.get("robot"),
        body=config.get("body", {}).get("kind"),
        geometry=config.get("geometry"),
        gate={name: config["gate"][name] for name in ("speed", "reverse_speed", "angle", "tilt", "leases")},
        devices=sorted(devices),
        lens=(devices.get("camera") or {}).get("driver", {}).get("lens"),
        goals=(config.get("planner") or {}).get("mode", "ros2") != "ros2",
        mapping=bool(config.get("slam") or (config.get("planner") or {}).get("map")),
        explores=config.get("explorer") is not None,
        tracks=config.get("tracker") is not None,
        path=PurePath(drawn["file"]).stem if (drawn := config.get("path")) else None,
        behaviours=sorted(config.get("behaviours") or {}),
        docks={
            name: {"pose": [dock["x"], dock["y"], dock["yaw"]], "direction": dock["direction"]}
            for name, dock in sorted((config.get("docks") or {}).items())
        },
        versions=versions,
    )


def grid_head(of: Grid) -> dict[str, Any]:
    """Return the geometry of a grid's cells."""
    return {
        "width": of.width,
        "height": of.height,
        "resolution": of.resolution,
        "origin": [of.origin.x, of.origin.y, of.origin.yaw],
        "frame": of.frame,
    }


def tile(of: Grid, version: int) -> bytes:
    """Return a map tile changed since ``version``; payload: int8 cells, row 0 at the lowest y."""
    return binary("tile", of.cells.tobytes(), version=version, **grid_head(of))


def ground(of: Ground) -> bytes:
    """Return the ground; payload: zlib of the uint8 roughness (standard deviation in mm), 255 = unknown."""
    head = {"width": of.width, "height": of.height, "resolution": of.resolution, "frame": of.frame}
    origin = [of.origin.x, of.origin.y, of.origin.yaw]
    return binary("ground", zlib.compress(of.roughness.tobytes(), 1), origin=origin, **head)


def _rounded(*values: float) -> list[float]:
    return [round(value, 4) for value in values]
