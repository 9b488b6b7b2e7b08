"""Zones for tests."""

from monstertruck_schemas.zones import Zone, Zones

SQUARE = ((2.0, -0.5), (3.0, -0.5), (3.0, 0.5), (2.0, 0.5))


def zone(name="stairs", corners=SQUARE, kind="keepout", **more):
    return Zone(name=name, kind=kind, corners=corners, **more)


def zones(*which, stamp=0, **more):
    return Zones(stamp=stamp, received=stamp, seq=0, frame="map", zones=which, **more)
