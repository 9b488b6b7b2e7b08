"""Settings of the ground's grid; light."""

from monstertruck_schemas.base import Positive, Schema


class GroundConfig(Schema):
    """What the ground is like, for route planners."""

    period: Positive = 2.0
    """Seconds between two messages, if something has changed"""
    slip_roughness: Positive = 0.05
    """Ground on which the wheels slip counts as this rough, m"""
    save_period: Positive = 60.0
    """Seconds between two saves, where the map is saved"""
