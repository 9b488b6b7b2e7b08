"""Receiver messages, independent of the protocol."""

from typing import NamedTuple, Protocol

from monstertruck_drivers.receiver.protocol import ChannelWords


class ReceiverFrame(NamedTuple):
    """One message from a receiver; fields that it does not contain are None."""

    channels: ChannelWords | None = None
    quality: float | None = None
    """Fraction of the radio's packets that arrive, 0 to 1."""
    rssi: float | None = None
    """Signal strength at the better antenna (dBm)."""
    failsafe: bool = False
    """The receiver reports that it has lost its transmitter."""
    lost: bool = False
    """The receiver missed a packet, so the channels are from an earlier packet."""


class ReceiverParser(Protocol):
    """Extracts messages from a receiver's byte stream."""

    refused: int
    """Number of bytes outside of messages."""

    def feed(self, data: bytes) -> list[ReceiverFrame]:
        """Return the completed messages."""
