"""Rows of the lidars, in the middle of a square room, on a robot that turns at 1 rad/s in either direction.

`step`: displacement of the worst beam, in steps of the scan. `deskew_mm`: 95th percentile of the distance between a
wall 3 m away and the ends of beams that meet it perpendicularly, each beam placed by its own time; worst scan of either
direction of turn. `clock_ms`: maximum error of the stamps, from the yaw error of a whole scan at 1 rad/s.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.devices_today_parts.body_sensors import SensorBench, trouble
from benchmarks.devices_today_parts.kit import Newest, on_bench, running
from monstertruck_drivers.emulation import RangeSheet
from monstertruck_drivers.hokuyo_urg.config import HokuyoLxConfig
from monstertruck_drivers.hokuyo_urg.driver import HokuyoDriver
from monstertruck_drivers.hokuyo_urg.lx_emulator import LxEmulator
from monstertruck_drivers.hokuyo_urg.models import LX
from monstertruck_drivers.ld19.config import Ld19Config
from monstertruck_drivers.ld19.driver import Ld19Driver
from monstertruck_drivers.ld19.emulator import Ld19Emulator
from monstertruck_drivers.ld19.protocol import MODELS as LD19_MODELS
from monstertruck_drivers.rplidar.config import RplidarConfig
from monstertruck_drivers.rplidar.driver import RplidarDriver
from monstertruck_drivers.rplidar.emulator import RplidarEmulator
from monstertruck_drivers.rplidar.protocol import MODELS as RPLIDAR_MODELS
from monstertruck_runtime.clock import SECOND, VirtualClock
from monstertruck_schemas.sensor import VALID_BEAM, LaserScan

Array = NDArray[np.float64]
WALL = 3.0
"""Distance of the walls, m."""
SPUN_UP = 5.0
MEASURED = 10.0
"""Seconds until scans count, and seconds of those that do."""
HEAD_ON = math.radians(10.0)
STEPS = np.linspace(-2.0, 2.0, 81)
TURNS = np.arange(-0.02, 0.02, 0.0005)
"""Turns of a whole scan that are tried, rad; at 1 rad/s as many seconds."""
HOLE = 0.006
"""Difference of ranges that quantisation explains, m."""


def to_wall(ways: Array) -> Array:
    """Return the range from the middle of the room in directions (n,), m."""
    return np.asarray(WALL / np.maximum(np.abs(np.cos(ways)), np.abs(np.sin(ways))))


class Turning:
    """``BeamSource`` of a scanner in the middle of the room, on a robot that turns."""

    def __init__(self, rate: float) -> None:
        self.rate = rate

    def beams(self, bearings: Array, times_ns: NDArray[np.int64], sheet: RangeSheet) -> Array:
        """See ``BeamSource``."""
        ranges = to_wall(bearings + self.rate * times_ns / SECOND)
        return np.where(ranges <= sheet.greatest, ranges, np.inf)


def placed(scan: LaserScan, rate: float) -> tuple[Array, Array]:
    """Return directions (rad) and ranges (m) of the returns, each (n,), with the robot's turn removed."""
    beams = np.flatnonzero(scan.codes == VALID_BEAM)
    times = scan.stamp + beams * scan.time_increment * SECOND
    return scan.start_angle + scan.angle_increment * beams + rate * times / SECOND, scan.ranges[beams]


def step_error(scan: LaserScan, rate: float) -> float:
    """Return the displacement of the worst beam in steps."""
    ways, ranges = placed(scan, rate)
    tried = [np.abs(to_wall(ways + steps * scan.angle_increment) - ranges) < HOLE for steps in STEPS]
    off = np.where(np.array(tried), np.abs(STEPS)[:, None], math.inf).min(axis=0)
    return float(off.max())


def deskew_error(scan: LaserScan, rate: float) -> float:
    """Return the 95th percentile of the distance (mm) of perpendicular beam ends from the wall."""
    ways, ranges = placed(scan, rate)
    bearing = np.remainder(ways + math.pi / 4, math.pi / 2) - math.pi / 4
    near = np.abs(bearing) < HEAD_ON
    return float(np.percentile(np.abs(ranges[near] * np.cos(bearing[near]) - WALL), 95)) * 1000


def clock_error(scan: LaserScan, rate: float) -> float:
    """Return the error of the stamp, ms."""
    ways, ranges = placed(scan, rate)
    misfit = [float(np.mean((to_wall(ways + turn) - ranges) ** 2)) for turn in TURNS]
    return abs(float(TURNS[int(np.argmin(misfit))])) * 1000


TURNING_HEAD = (("silent on", "silent off"), ("blocked on", "blocked off"))
"""How the emulator of a turning head is stalled, and goes on."""


def measured(
    make: Callable[[VirtualClock, float], SensorBench],
    foreign: str,
    stalls: tuple[tuple[str, str], ...] = TURNING_HEAD,
    mute: str = "silent on",
) -> dict[str, Any]:
    """Measure a lidar; ``make`` receives the clock and the robot's turn rate."""
    found: dict[str, list[float]] = {"step": [], "deskew_mm": [], "clock_ms": []}
    for rate in (1.0, -1.0):

        async def scans(bench: SensorBench) -> list[LaserScan]:
            async with running(bench.serve()):
                await bench.clock.sleep(SPUN_UP + MEASURED)
            return [scan for scan in bench.out.kept if scan.stamp > (1.0 + SPUN_UP) * SECOND]

        for scan in on_bench(lambda clock, turn=rate: make(clock, turn), scans):
            found["step"].append(step_error(scan, rate))
            found["deskew_mm"].append(deskew_error(scan, rate))
            found["clock_ms"].append(clock_error(scan, rate))
    row: dict[str, Any] = {name: round(max(values), 1) for name, values in found.items()}
    passed = trouble(lambda clock: make(clock, 0.0), "healthy", *stalls, mute=mute)
    return row | {"trouble": passed, "foreign": foreign}


def ld19(model: Any) -> dict[str, Any]:
    """LD06, LD19 or STL-19P."""

    def make(clock: VirtualClock, rate: float) -> SensorBench:
        def driver(port: Any, events: Any, out: Newest[LaserScan]) -> Ld19Driver:
            return Ld19Driver(Ld19Config(model=model), port, clock, out, events)

        return SensorBench(clock, Ld19Emulator(clock, Turning(rate), LD19_MODELS[model]), driver)

    return measured(make, "tests/unit/drivers/ld19/test_third_party.py")


def rplidar(model: Any, mode: str) -> dict[str, Any]:
    """A RPLIDAR in one of its modes."""

    def make(clock: VirtualClock, rate: float) -> SensorBench:
        def driver(port: Any, events: Any, out: Newest[LaserScan]) -> RplidarDriver:
            return RplidarDriver(RplidarConfig(model=model, scan_mode=mode), port, clock, out, events)

        return SensorBench(clock, RplidarEmulator(clock, Turning(rate), RPLIDAR_MODELS[model]), driver)

    return measured(make, "tests/unit/drivers/rplidar/test_third_party.py")


def hokuyo(model: Any) -> dict[str, Any]:
    """A UST or UTM."""

    def make(clock: VirtualClock, rate: float) -> SensorBench:
        def driver(port: Any, events: Any, out: Newest[LaserScan]) -> HokuyoDriver:
            return HokuyoDriver(HokuyoLxConfig(model=model), port, clock, out, events)

        return SensorBench(clock, LxEmulator(clock, Turning(rate), LX[model]), driver)

    stalls = ("deaf on", "deaf off"), ("unstable 60", "unstable 0")
    return measured(make, "tests/unit/drivers/hokuyo_urg/test_lx.py", stalls, mute="deaf on")


ROWS: dict[str, Callable[[], dict[str, Any]]] = {
    **{model: partial(hokuyo, model) for model in LX},
    **{model: partial(ld19, model) for model in LD19_MODELS},
    **{
        f"rplidar_{model}_{mode.name.lower()}": partial(rplidar, model, mode.name)
        for model, unit in RPLIDAR_MODELS.items()
        for mode in unit.modes
    },
}
