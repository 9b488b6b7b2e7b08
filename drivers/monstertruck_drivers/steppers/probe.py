"""Who is on the port, and what do the motors do: without moving or changing anything."""

from monstertruck_drivers.link import Port
from monstertruck_drivers.steppers.config import StepperConfig
from monstertruck_drivers.steppers.session import ASK_ATTEMPTS, StepperSession
from monstertruck_runtime.clock import Clock


async def probe(port: Port, clock: Clock, settings: StepperConfig | None = None) -> dict[str, object]:
    """Identity and one status.

    Returns:
        JSON-able: ``device``, ``port``, ``version``, ``motors``, ``steps_per_turn``, ``state``, ``bad_lines``,
        ``uptime_s``, ``positions`` in steps, ``rates`` in steps/s.

    Raises:
        DeviceLostError: not plugged in.
        DeviceTimeoutError: silence.
        ProtocolError: an answer out of form.
        WrongDeviceError: another device.
        PortBusyError: another process holds the port.
    """
    async with await port.open() as link:
        session = StepperSession(link, clock, (settings or StepperConfig()).answer_timeout)
        identity = await session.identify()
        status = await session.status("S", identity.motors, attempts=ASK_ATTEMPTS)
    return {
        "device": "stepper motors on a microcontroller",
        "port": port.name,
        "version": identity.version,
        "motors": identity.motors,
        "steps_per_turn": identity.steps_per_turn,
        "state": status.state.name.lower(),
        "bad_lines": status.bad_lines,
        "uptime_s": status.uptime_ms / 1000,
        "positions": list(status.positions),
        "rates": [rate / 1000 for rate in status.rates],
    }
