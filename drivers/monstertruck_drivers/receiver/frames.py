"""What a receiver says, whatever its protocol."""

from typing import NamedTuple, Protocol

from monstertruck_drivers.receiver.protocol import ChannelWords


class ReceiverFrame(NamedTuple):
    """One message of a receiver; what it does not say is None."""

    channels: ChannelWords | None = None
    quality: float | None = None
    """Share of the radio's packets that arrive, 0 to 1."""
    rssi: float | None = None
    """Of the better antenna, dBm."""
    failsafe: bool = False
    """The receiver itself says that it has lost its transmitter."""
    lost: bool = False
    """The receiver missed a packet: the channels are those of an earlier one."""


class ReceiverParser(Protocol):
    """Cuts the bytes of a receiver into messages."""

    refused: int
    """Bytes that belonged to none."""

    def feed(self, data: bytes) -> list[ReceiverFrame]:
        """Return messages that became complete."""
