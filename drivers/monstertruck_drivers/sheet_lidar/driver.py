"""Driver for a laser scanner described by its data sheet: receives and publishes every scan."""

import numpy as np

from monstertruck_drivers.link import Link
from monstertruck_drivers.scanning.clock_map import ClockMap
from monstertruck_drivers.scanning.driver import ScannerDriver
from monstertruck_drivers.scanning.turns import MISSING
from monstertruck_drivers.sheet_lidar.config import SheetLidarConfig
from monstertruck_drivers.sheet_lidar.protocol import STAMP_TURN, SheetParser, SheetScan
from monstertruck_drivers.streaming import DeviceStream
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.ports import Ready
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import NO_ECHO, VALID_BEAM, LaserScan

EXPECTED = "of a scanner with the configured number of beams: another device, or another data sheet"


class SheetLidarDriver(ScannerDriver[SheetLidarConfig]):
    """Driver for a scanner on a port."""

    async def run(self, ready: Ready) -> None:
        """Serve one session.

        Raises:
            DeviceLostError: the scanner was unplugged.
            DeviceTimeoutError: the scanner is silent, or its scans have arrived late for several seconds.
            ProtocolError: bytes arrive without a valid scan.
            WrongDeviceError: the first bytes contain no scan with the configured number of beams.
            PortBusyError: another process holds the port.
        """
        config = self._config
        async with await self._port.open() as link:
            stream = DeviceStream(link, self._clock, SheetParser(config.beams).feed)
            transfer = 0.001  # assumed time from the last beam to the arrival of the frame (s)
            latency = config.time_increment * config.beams + transfer
            mapping = ClockMap(round(latency * SECOND), turn=STAMP_TURN)
            scans = await stream.first(config.first_scan, EXPECTED)
            ready()
            self._events(Reason.DEVICE_READY, Severity.INFO, self.name, f"{config.beams} beams, {config.rate:g} Hz")
            while True:
                arrival = self._clock.now()
                for scan in scans:
                    self._publish(scan, self._watch.stamp(mapping, scan.stamp, arrival, link.name), arrival)
                scans = await stream.receive(config.stale)

    def _publish(self, scan: SheetScan, stamp: int, received: int) -> None:
        config, met = self._config, scan.ranges > 0
        self._out.put(
            LaserScan(
                stamp=stamp,
                received=received,
                seq=self._out.next_seq(),
                frame=config.frame or self.name,
                start_angle=config.start_angle,
                end_angle=config.start_angle + config.increment * (config.beams - 1),
                time_increment=config.time_increment,
                scan_time=1.0 / config.rate,
                range_min=config.range_min,
                range_max=config.range_max,
                ranges=np.where(met, scan.ranges / 1000.0, np.inf),
                codes=np.where(met, VALID_BEAM, NO_ECHO if self._config.no_return == "free" else MISSING).astype(
                    np.uint8
                ),
                range_noise=config.sheet.noise,
            )
        )


async def identify(link: Link, clock: Clock, settings: SheetLidarConfig) -> dict[str, object]:
    """Wait for one scan.

    Returns:
        JSON-compatible dict: ``beams``, ``stamp_ms``, ``returns``.

    Raises:
        DeviceError: the same errors as from the driver's ``run``.
    """
    stream = DeviceStream(link, clock, SheetParser(settings.beams).feed)
    scan = (await stream.first(settings.first_scan, EXPECTED))[-1]
    return {"beams": len(scan.ranges), "stamp_ms": scan.stamp, "returns": int((scan.ranges > 0).sum())}
