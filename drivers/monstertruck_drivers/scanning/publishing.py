"""Publish the revolutions of a turning head as scans."""

import math

import numpy as np

from monstertruck_drivers.emulation import RangeSheet
from monstertruck_drivers.scanning.config import TurningHeadConfig
from monstertruck_drivers.scanning.turns import HeadTurn, codes_of
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.ports import Publisher
from monstertruck_schemas.roles import DeviceRole
from monstertruck_schemas.sensor import LaserScan


def publish(
    turn: HeadTurn,
    origin: int,
    received: int,
    sheet: RangeSheet,
    config: TurningHeadConfig,
    out: Publisher[LaserScan],
    name: str = DeviceRole.LIDAR,
) -> None:
    """Publish a revolution of a head that turns clockwise.

    Args:
        turn: the revolution.
        origin: daemon's time at the zero of the samples' clock (ns).
        received: arrival time of the revolution's last sample (ns).
        sheet: the scanner's ranges and noise.
        config: scanner settings.
        out: scan publisher.
        name: service name; also the default frame.
    """
    start = math.pi - math.tau * turn.first
    count = len(turn.ranges)
    out.put(
        LaserScan(
            stamp=origin + round(turn.begin),
            received=received,
            seq=out.next_seq(),
            frame=config.frame or name,
            start_angle=start,
            end_angle=start - math.tau * turn.step * (count - 1),
            time_increment=turn.period * turn.step / SECOND,
            scan_time=turn.period / SECOND,
            range_min=sheet.least,
            range_max=sheet.greatest,
            ranges=np.where(turn.ranges > 0.0, turn.ranges, np.inf),
            codes=codes_of(turn, free=config.no_return == "free"),
            intensities=turn.intensities,
            range_noise=sheet.noise,
        )
    )
