"""BNO085 driver: converts frames to tilt, turn rates and specific forces."""

from math import cos, degrees, hypot, pi, sin, tau
from typing import Final

from monstertruck_drivers.bno085.config import Bno085Config
from monstertruck_drivers.bno085.protocol import INDICES, RATE, RvcFrame, RvcParser
from monstertruck_drivers.inertial import Xyz, corrected_force, corrected_rate, mean
from monstertruck_drivers.link import Link, Port
from monstertruck_drivers.streaming import DeviceStream
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import ProtocolError
from monstertruck_runtime.ports import EventSink, Publisher, Ready
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import STANDARD_GRAVITY, Attitude, Imu

LONGEST_GAP: Final = 10
"""Maximum number of frames missing between two frames that yield a turn rate; at 10 rad/s half a turn is 31 frames."""


def body_rates(before: RvcFrame, after: RvcFrame) -> Xyz | None:
    """Return the turn rates between two frames (rad/s) in the unit's axes; None if they are identical or too far apart.

    The time base is the unit's clock: the difference of the indices is the time between the frames in hundredths of a
    second.
    """
    steps = (after.number - before.number) % INDICES
    if not 0 < steps <= LONGEST_GAP:
        return None
    yaw_rate, pitch_rate, roll_rate = (
        ((new - old + pi) % tau - pi) * RATE / steps for old, new in zip(before.angles, after.angles, strict=True)
    )
    _, pitch, roll = after.angles
    return (
        roll_rate - yaw_rate * sin(pitch),
        pitch_rate * cos(roll) + yaw_rate * sin(roll) * cos(pitch),
        yaw_rate * cos(roll) * cos(pitch) - pitch_rate * sin(roll),
    )


class Bno085Driver:
    """Receives the unit's stream; the unit accepts no requests.

    Args:
        config: averaging and check settings.
        port: the unit's port.
        clock: time.
        out: angular velocity and specific force, in the unit's axes.
        attitude: tilt; its heading, relative to power-up, is marked as untrustworthy. None if a compass measures the
            attitude.
        events: receives an event when frames are missing.
        name: name of the service and of the frame.
    """

    def __init__(
        self,
        config: Bno085Config,
        port: Port,
        clock: Clock,
        out: Publisher[Imu],
        attitude: Publisher[Attitude] | None,
        events: EventSink,
        name: str = "imu",
    ) -> None:
        self.name = name
        self._config = config
        self._port = port
        self._clock = clock
        self._out = out
        self._attitude = attitude
        self._events = events

    async def run(self, ready: Ready) -> None:
        """Serve one session.

        Raises:
            DeviceLostError: the unit was unplugged.
            DeviceTimeoutError: no bytes arrive.
            ProtocolError: bytes arrive without a valid frame, or identical measurements repeat.
            WrongDeviceError: the first bytes contain no frame.
            PortBusyError: another process holds the port.
        """
        async with await self._port.open() as link:
            stream = DeviceStream(link, self._clock, RvcParser().feed)
            frames = await first_frames(stream)
            ready()
            last, equal, heard_at = frames[0], 0, self._clock.now()
            rates: list[Xyz] = []
            forces: list[Xyz] = []
            lost = False
            while True:
                paused = self._clock.now() - heard_at > LONGEST_GAP * SECOND // RATE
                heard_at = self._clock.now()
                for frame in frames:
                    rate = None if paused else body_rates(last, frame)
                    paused = False
                    equal = equal + 1 if rate is not None and frame[4:] == last[4:] else 0
                    if rate is not None:
                        rates.append(rate)
                        forces.append(frame.acceleration)
                    elif frame is not last and not lost:
                        lost = True
                        text = f"{self._port.name}: frames are missing"
                        self._events(Reason.DEVICE_PROTOCOL, Severity.WARNING, self.name, text)
                    last = frame
                    if len(rates) >= self._config.average:
                        self._publish(frame, rates, forces)
                        rates, forces = [], []
                if equal >= self._config.stuck_after:
                    raise ProtocolError(f"{link.name}: {equal} measurements in a row are identical")
                frames = await stream.receive(self._config.silence)

    def _publish(self, frame: RvcFrame, rates: list[Xyz], forces: list[Xyz]) -> None:
        config, received = self._config, self._clock.now()
        newest = received - round(config.delay * SECOND)
        self._out.put(
            Imu(
                # A rate applies midway between its two frames; the mean applies midway between the averaged rates.
                stamp=newest - len(rates) * SECOND // (2 * RATE),
                received=received,
                seq=self._out.next_seq(),
                frame=self.name,
                angular_velocity=corrected_rate(mean(rates), config.correction),
                linear_acceleration=corrected_force(mean(forces), config.correction),
            )
        )
        if self._attitude is None:
            return
        yaw, pitch, roll = frame.angles
        force = hypot(*frame.acceleration) / STANDARD_GRAVITY
        self._attitude.put(
            Attitude(
                stamp=newest,
                received=received,
                seq=self._attitude.next_seq(),
                frame=config.frame,
                heading=-yaw % tau,
                roll=roll,
                pitch=pitch,
                heading_disturbed=True,
                tilt_valid=abs(force - 1) <= config.gravity_tolerance,
            )
        )


async def first_frames(stream: DeviceStream[RvcFrame]) -> list[RvcFrame]:
    """Wait for the first frames of a session. Raises the same errors as ``DeviceStream.first``."""
    listen = 1.0  # seconds to receive a frame at the start; the unit needs a few tenths after power-up
    return await stream.first(
        listen, "of a BNO085 in UART-RVC mode: another device, another baud rate, or PS0 and PS1 set for another mode"
    )


async def identify(link: Link, clock: Clock, settings: Bno085Config) -> dict[str, object]:
    """Wait for one frame.

    Returns:
        JSON-compatible dict: ``yaw_deg`` since power-up, ``pitch_deg``, ``roll_deg``, ``acceleration`` (m/s^2).

    Raises:
        DeviceError: the same errors as from the driver's ``run``.
    """
    frame = (await first_frames(DeviceStream(link, clock, RvcParser().feed)))[-1]
    yaw, pitch, roll = (round(degrees(angle), 2) for angle in frame.angles)
    return {"yaw_deg": yaw, "pitch_deg": pitch, "roll_deg": roll, "acceleration": frame.acceleration}
