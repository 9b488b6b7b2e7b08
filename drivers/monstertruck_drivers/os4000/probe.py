"""Identify a compass on the port and read it."""

from monstertruck_drivers.link import Port
from monstertruck_drivers.os4000.config import Os4000Config
from monstertruck_drivers.os4000.protocol import Fields, Key
from monstertruck_drivers.os4000.session import Os4000Session, observed_fields, observed_rate
from monstertruck_runtime.clock import Clock


async def probe(port: Port, clock: Clock, settings: Os4000Config | None = None) -> dict[str, object]:
    """Listen, and ask for the firmware version. Only a silent unit is set to another rate.

    Returns:
        JSON-able: ``device``, ``port``, ``version`` (lines the unit prints), ``rate`` in Hz, ``fields`` (names),
        ``sample`` in the device's units and signs.

    Raises:
        DeviceLostError: not plugged in.
        DeviceTimeoutError: silence.
        WrongDeviceError: another device, or another baud rate than the port's.
        PortBusyError: another process holds the port.
    """
    async with await port.open() as link:
        session = Os4000Session(link, clock)
        heard = await session.start(20)  # set only when the unit was set to be silent
        version = await session.ask(Key.VERSION)
    _, sample = heard[-1]
    rate = observed_rate(heard)
    fields = observed_fields(heard)
    return {
        "device": "OceanServer OS4000",
        "port": port.name,
        "version": version,
        "rate": None if rate is None else round(rate, 1),
        "fields": [(bit.name or "").lower() for bit in Fields if bit in fields],
        "sample": {
            "heading_deg": sample.heading,
            "pitch_deg": sample.pitch,
            "roll_deg": sample.roll,
            "temperature_c": sample.temperature,
            "field_mg": sample.field,
            "acceleration_g": sample.acceleration,
        },
    }
