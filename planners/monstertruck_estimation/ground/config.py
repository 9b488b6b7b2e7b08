"""Settings of the ground grid; light."""

from monstertruck_schemas.base import Positive, Schema


class GroundConfig(Schema):
    """Ground properties for route planners."""

    period: Positive = 2.0
    """Time between two messages, if something has changed (s)"""
    slip_roughness: Positive = 0.05
    """Roughness assumed for ground with wheel slip (m)"""
    save_period: Positive = 60.0
    """Time between two saves, where the map is saved (s)"""
