"""Requests to VESCs and their answers over one open link; shared by the driver and `identify`."""

from collections.abc import Callable
from typing import Final

from monstertruck_drivers.link import Link
from monstertruck_drivers.vesc.config import VescConfig
from monstertruck_drivers.vesc.protocol import (
    OLDEST_FIRMWARE,
    Deframer,
    FirmwareIdentity,
    MotorValues,
    PacketError,
    PacketId,
    WatchdogSetting,
    fault_text,
    forwarded,
    frame,
    request,
)
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import DeviceMismatchError, DeviceTimeoutError, ProtocolError, WrongDeviceError

ATTEMPTS: Final = 3
"""Attempts for each request at the start of a session."""
SETTINGS_TIMEOUT: Final = 0.5
"""Timeout of long answers (about 500 bytes) and of requests that restart the applications (s)."""


class VescSession:
    """One session. Packets carry no sequence number: an answer is identified by its kind and, for values, the CAN id.

    Args:
        link: open link.
        clock: time.
        timeout: maximum time to wait for an answer (s).
    """

    def __init__(self, link: Link, clock: Clock, timeout: float) -> None:
        self.deframer = Deframer()
        self.asked = 0
        """Send time of the latest request (ns)."""
        self.heard = False
        """Whether a complete packet has arrived."""
        self._link = link
        self._clock = clock
        self._timeout = timeout

    def send(self, can_id: int | None, payload: bytes) -> None:
        """Send a payload that has no answer.

        Raises:
            DeviceLostError: the controller was unplugged.
        """
        self._link.write(frame(forwarded(can_id, payload)))

    async def identify(self, can_id: int | None) -> FirmwareIdentity:
        """Identify a controller.

        Raises:
            DeviceLostError: the controller was unplugged.
            DeviceTimeoutError: the controller is silent.
            WrongDeviceError: another device answers.
            DeviceMismatchError: no controller answers at the CAN id, or its firmware is too old.
        """
        who = f"{self._link.name}: "
        try:
            answer = await self._ask(can_id, request(PacketId.FW_VERSION), PacketId.FW_VERSION, attempts=ATTEMPTS)
            identity = FirmwareIdentity.of(answer)
        except (DeviceTimeoutError, PacketError) as error:
            if self.heard and can_id is not None:
                raise DeviceMismatchError(f"{who}no VESC answers at CAN id {can_id}") from error
            if self.deframer.bad and not self.heard:
                raise WrongDeviceError(f"{who}not a VESC, it sends {self.deframer.strange.hex(' ')}") from error
            if isinstance(error, PacketError):
                raise ProtocolError(f"{who}{error}") from error
            raise
        if identity.major < OLDEST_FIRMWARE:
            text = f"firmware {identity.major}.{identity.minor:02}: expected {OLDEST_FIRMWARE} or newer; update it"
            raise DeviceMismatchError(f"{who}{text} with VESC Tool")
        return identity

    async def values(self, can_id: int | None, attempts: int = 1) -> MotorValues:
        """Return a motor's values.

        Raises:
            DeviceLostError: the controller was unplugged.
            DeviceTimeoutError: the answer did not arrive within the timeout.
            ProtocolError: the answer is malformed.
        """
        until_id = None if can_id is None else lambda payload: MotorValues.of(payload).controller_id == can_id
        try:
            return MotorValues.of(
                await self._ask(can_id, request(PacketId.GET_VALUES), PacketId.GET_VALUES, until_id, attempts=attempts)
            )
        except PacketError as error:
            raise ProtocolError(f"{self._link.name}: {error}") from error

    async def set_watchdog(self, can_id: int | None, wanted: WatchdogSetting) -> bool:
        """Make a controller brake by itself when set-points stop; its flash is not written.

        Returns:
            Whether the controller's settings differed before.

        Raises:
            DeviceLostError: the controller was unplugged.
            DeviceTimeoutError: the answer did not arrive within the timeout.
            DeviceMismatchError: the controller does not apply the setting.
            ProtocolError: the answer is malformed.
        """
        settings = await self._settings(can_id)
        if _equal(found := self._watchdog(settings), wanted):
            return False
        try:
            number = PacketId.SET_APPCONF_NO_STORE
            await self._ask(can_id, wanted.applied(settings), number, attempts=1, timeout=SETTINGS_TIMEOUT)
            found = self._watchdog(await self._settings(can_id))
        except DeviceTimeoutError:
            pass  # firmware without temporary settings does not answer
        if not _equal(found, wanted):
            raise DeviceMismatchError(
                f"{self._link.name}: its watchdog stays at {found.milliseconds} ms and {found.brake_current:g} A; set "
                f"Timeout {wanted.milliseconds} ms and Timeout Brake Current {wanted.brake_current:g} A in VESC Tool, "
                "App Settings, General"
            )
        return True

    def _watchdog(self, settings: bytes) -> WatchdogSetting:
        try:
            return WatchdogSetting.of(settings)
        except PacketError as error:
            raise ProtocolError(f"{self._link.name}: {error}") from error

    async def _settings(self, can_id: int | None) -> bytes:
        number = PacketId.GET_APPCONF
        return await self._ask(can_id, request(number), number, attempts=ATTEMPTS, timeout=SETTINGS_TIMEOUT)

    async def _ask(
        self,
        can_id: int | None,
        payload: bytes,
        wanted: PacketId,
        fits: Callable[[bytes], bool] | None = None,
        *,
        attempts: int,
        timeout: float | None = None,
    ) -> bytes:
        within = self._timeout if timeout is None else timeout
        for _ in range(attempts):
            if self._link.discard():
                self.deframer.restart()  # an answer that arrived late
            self.asked = self._clock.now()
            self.send(can_id, payload)
            due = self.asked + round(within * SECOND)
            while (left := due - self._clock.now()) > 0:
                try:
                    data = await self._link.read(left / SECOND)
                except TimeoutError:
                    break
                for answer in self.deframer.feed(data):
                    self.heard = True
                    if answer[0] == wanted and (fits is None or fits(answer)):
                        return answer
        raise DeviceTimeoutError(f"{self._link.name}: no answer to {wanted.name} within {within} s")


def _equal(found: WatchdogSetting, wanted: WatchdogSetting) -> bool:
    """Whether settings are equal in single precision."""
    close = abs(found.brake_current - wanted.brake_current) < 1e-3 * wanted.brake_current
    return found.milliseconds == wanted.milliseconds and close


async def identify(link: Link, clock: Clock, settings: VescConfig) -> dict[str, object]:
    """Read identity and values of every configured controller, without moving or changing anything.

    Returns:
        JSON-compatible dict: for each of ``motors`` its ``can_id``, ``hardware``, ``firmware``, ``serial``, ``erpm``,
        ``tachometer``, ``volts``, ``fault``.

    Raises:
        DeviceError: the same errors as from the driver's ``run``.
    """
    session = VescSession(link, clock, settings.answer_timeout)
    found = []
    for motor in settings.motors:
        identity = await session.identify(motor.can_id)
        values = await session.values(motor.can_id, ATTEMPTS)
        found.append(
            {
                "can_id": values.controller_id,
                "hardware": identity.hardware,
                "firmware": f"{identity.major}.{identity.minor:02}",
                "serial": identity.serial.hex(),
                "erpm": values.erpm,
                "tachometer": values.tachometer,
                "volts": values.volts,
                "fault": fault_text(values.fault),
            }
        )
    return {"motors": found}
