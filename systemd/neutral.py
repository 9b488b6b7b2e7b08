"""Stop the drive after any death of the daemon: quick stop, then power stage off.

    python3 neutral.py /dev/truck/drive [NODE]

NODE must equal ``devices.drive.driver.node`` of the configuration (default 1); the line runs at 38400 baud, as the
controller is delivered. Needs nothing but Python's standard library and the codec beside it. Exit code 0 once the
controller has accepted both commands, 1 if it did not within five seconds, for whatever reason.
"""

import os
import select
import sys
import termios
import time
import tty
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "drivers"))

from monstertruck_drivers.epos.protocol import Frame, FrameError, decode_body, stop_frames

PATIENCE = 5.0
FRAME_TIMEOUT = 0.55
"""The controller forgets a half-received frame after 500 ms of silence."""
BRAKING = 0.4
"""Seconds from full speed to rest, with room to spare."""
OKAY = b"O"
ANSWER = 0x00
"""Opcode of every answer."""


class NotStoppedError(Exception):
    """The controller stayed silent, answered something else, or refused."""


def main(arguments: list[str]) -> int:
    """Entry point; returns the exit code."""
    port, node = arguments[0], int(arguments[1]) if len(arguments) > 1 else 1
    give_up = time.monotonic() + PATIENCE
    while time.monotonic() < give_up:
        try:
            stop(port, node)
        except (OSError, termios.error, FrameError, NotStoppedError) as error:
            print(f"neutral: {port}: {error}", file=sys.stderr)
            time.sleep(FRAME_TIMEOUT)
        else:
            print(f"neutral: {port}: stopped")
            return 0
    return 1


def stop(port: str, node: int) -> None:
    """Open the port and make both writes.

    Raises:
        OSError: the port cannot be used.
        NotStoppedError: the controller did not accept a command.
        FrameError: an answer was damaged.
    """
    line = os.open(port, os.O_RDWR | os.O_NOCTTY)
    try:
        tty.setraw(line)
        settings = termios.tcgetattr(line)
        settings[4] = settings[5] = termios.B38400
        termios.tcsetattr(line, termios.TCSANOW, settings)
        termios.tcflush(line, termios.TCIOFLUSH)
        brake, switch_off = stop_frames(node)
        exchange(line, brake)
        time.sleep(BRAKING)  # a motor without power only coasts
        exchange(line, switch_off)
    finally:
        os.close(line)


def exchange(line: int, frame: Frame) -> None:
    """One request and its answer (handshake of the first-generation EPOS on RS232)."""
    os.write(line, frame.head)
    expect(line, OKAY)
    os.write(line, frame.body)
    expect(line, OKAY)
    expect(line, bytes([ANSWER]))
    os.write(line, OKAY)
    length = receive(line, 1)
    answer = decode_body(ANSWER, length + receive(line, 2 * (length[0] + 1) + 2))
    os.write(line, OKAY)
    if code := answer.words[0] | answer.words[1] << 16:
        raise NotStoppedError(f"refused with error 0x{code:08X}")


def expect(line: int, wanted: bytes) -> None:
    """Read one byte that must be ``wanted``."""
    if (got := receive(line, 1)) != wanted:
        raise NotStoppedError(f"expected {wanted!r}, got {got!r}")


def receive(line: int, count: int) -> bytes:
    """Read exactly ``count`` bytes."""
    data = b""
    while len(data) < count:
        if not select.select([line], [], [], 0.25)[0]:
            raise NotStoppedError("no answer")
        data += os.read(line, count - len(data))
    return data


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
