"""Points of interest as tables and files: CSV, GeoJSON (coordinates in the map's metres), YAML."""

import csv
import io
import json
import math
from collections.abc import Sequence
from typing import Any, Final

from monstertruck_runtime.yaml_files import yaml_text
from monstertruck_schemas.base import position_deviation
from monstertruck_schemas.points import PointOfInterest

FORMATS: Final = (".csv", ".geojson", ".yaml")
COLUMNS: Final = ("name", "kind", "tag", "x_m", "y_m", "z_m", "yaw_rad", "sigma_m", "sigma_yaw_rad", "sightings")


def row_of(point: PointOfInterest) -> tuple[str, ...]:
    """Name and numbers for a table."""
    place = (f"{value:z.2f}" for value in (point.x, point.y, point.yaw))
    return point.name, *place, f"{100 * position_deviation(point.covariance):.1f}", str(point.sightings)


def values_of(point: PointOfInterest) -> dict[str, Any]:
    """What is exported, by ``COLUMNS``."""
    yaw_sigma = math.sqrt(float(point.covariance[8]))
    numbers = (point.x, point.y, point.z, point.yaw, position_deviation(point.covariance), yaw_sigma)
    values = (point.name, point.kind.value, point.tag, *(round(number, 4) for number in numbers), point.sightings)
    return dict(zip(COLUMNS, values, strict=True))


def text_of(points: Sequence[PointOfInterest], ending: str) -> str:
    """Points as a file of one of ``FORMATS``."""
    rows = [values_of(point) for point in points]
    if ending == ".csv":
        out = io.StringIO()
        writer = csv.DictWriter(out, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        return out.getvalue()
    if ending == ".yaml":
        return yaml_text({"frame": "map", "points": rows})
    features = [
        {
            "type": "Feature",
            "geometry": {"type": "Point", "coordinates": [row["x_m"], row["y_m"], row["z_m"]]},
            "properties": {name: value for name, value in row.items() if name not in ("x_m", "y_m", "z_m")},
        }
        for row in rows
    ]
    return json.dumps({"type": "FeatureCollection", "features": features}, indent=1) + "\n"
