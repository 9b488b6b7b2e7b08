"""Listening on a device's cable, and what the drive controller's bytes mean."""

from contextlib import suppress
from typing import Final

from monstertruck_drivers.cable import MemoryPort
from monstertruck_drivers.epos import objects as od
from monstertruck_drivers.epos.protocol import Control, FrameError, Opcode, decode_body, join
from monstertruck_runtime.clock import Clock

STOP_CONTROLS: Final = frozenset((Control.QUICK_STOP, Control.DISABLE_VOLTAGE, Control.HALT))


class WireTap:
    """Everything that passes a device's cable; stays with the device when it is plugged elsewhere.

    Args:
        port: where the device hangs now.
        clock: time.
    """

    def __init__(self, port: MemoryPort, clock: Clock) -> None:
        self.to_device: list[tuple[int, bytes]] = []
        """(ns, bytes) as the last of them reached the device."""
        self.to_host: list[tuple[int, bytes]] = []
        """(ns, bytes) as the last of them reached the host."""
        self._clock = clock
        port.device.on_bytes = self._pass

    def _pass(self, to_device: bool, data: bytes) -> None:
        (self.to_device if to_device else self.to_host).append((self._clock.now(), data))


def written(tap: WireTap, since: int = 0) -> list[tuple[int, int, int]]:
    """Objects the host wrote to an EPOS: (ns, index, raw value); what is no whole frame is skipped."""
    found = []
    for instant, data in tap.to_device:
        if instant < since:
            continue
        with suppress(FrameError):
            words = decode_body(Opcode.WRITE, data).words
            if len(words) == 4:
                found.append((instant, words[0], join(words[2], words[3])))
    return found


def stop_bytes(tap: WireTap, since: int) -> int | None:
    """Instant at which the first write that stops the motor has reached an EPOS: target 0, quick stop, halt, off."""
    for instant, index, value in written(tap, since):
        target = index == od.TARGET_VELOCITY.index and value == 0
        if target or (index == od.CONTROLWORD.index and value in STOP_CONTROLS):
            return instant
    return None
