"""monstertruckd: one asyncio daemon that owns every device of a four-wheel-steer robot truck."""

__version__ = "0.1.0"
