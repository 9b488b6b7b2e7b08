"""Stop every drive after any death of the daemon: quick stop, then power stage off.

    python3 neutral.py /dev/truck/drive[=NODE[@BAUD]] ...

One argument for each driven shaft, all stopped at once. NODE and BAUD must equal ``driver.node`` and ``port.baud`` of
the configuration's drive; left out they are those of the controller as delivered. Needs nothing but Python's
standard library and the codec installed with it. Exit code 0 once every controller has accepted both commands, 1 if
one did not within five seconds, for whatever reason.
"""

import os
import select
import sys
import termios
import threading
import time
import tty
from pathlib import Path

HERE = Path(__file__).resolve()
sys.path += [str(HERE.parents[1] / "drivers"), str(HERE.parents[2])]  # a checkout's, an installation's

from monstertruck_drivers.epos.protocol import BAUD, Frame, FrameError, decode_body, stop_frames

TIMEOUT = 5.0
FRAME_TIMEOUT = 0.55
"""The controller forgets a half-received frame after 500 ms of silence."""
ATTEMPT = 3.0
"""Longest time of one attempt on a port that works, s: ten waits for bytes of 0.25 s each, and braking."""
BRAKING = 0.4
"""Seconds from full speed to rest, with room to spare."""
OKAY = b"O"
ANSWER = 0x00
"""Opcode of every answer."""


class NotStoppedError(Exception):
    """The controller stayed silent, answered something else, or refused."""


def main(arguments: list[str]) -> int:
    """Entry point; returns the exit code."""
    drives = [drive(argument) for argument in arguments]
    stopped: list[str] = []
    # Daemons: the kernel may hold a port whose device takes no bytes for half a minute.
    threads = [threading.Thread(target=insist, args=(*one, stopped), daemon=True) for one in drives]
    end = time.monotonic() + TIMEOUT + ATTEMPT
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(max(0.0, end - time.monotonic()))
    return 0 if drives and len(stopped) == len(drives) else 1


def drive(argument: str) -> tuple[str, int, int]:
    """Port, node and baud rate that an argument names."""
    port, _, rest = argument.partition("=")
    node, _, baud = rest.partition("@")
    return port, int(node or 1), int(baud or BAUD)


def insist(port: str, node: int, baud: int, stopped: list[str]) -> None:
    """Try until the controller has stopped or the time-out; adds the port to ``stopped``."""
    give_up = time.monotonic() + TIMEOUT
    while time.monotonic() < give_up:
        try:
            stop(port, node, baud)
        except (OSError, termios.error, FrameError, NotStoppedError) as error:
            print(f"neutral: {port}: {error}", file=sys.stderr)
            time.sleep(FRAME_TIMEOUT)
        else:
            print(f"neutral: {port}: stopped")
            stopped.append(port)
            return


def stop(port: str, node: int, baud: int) -> None:
    """Open the port and make both writes.

    Raises:
        OSError: the port cannot be used.
        NotStoppedError: the controller did not accept a command.
        FrameError: an answer was damaged.
    """
    # An adapter that was plugged in again waits for a carrier, which no controller gives, before it opens.
    line = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        tty.setraw(line)
        settings = termios.tcgetattr(line)
        settings[2] |= termios.CLOCAL | termios.CREAD
        settings[4] = settings[5] = getattr(termios, f"B{baud}")
        termios.tcsetattr(line, termios.TCSANOW, settings)
        os.set_blocking(line, True)
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
    if len(answer.words) < 2:
        raise NotStoppedError("an answer without a result")
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
        part = os.read(line, count - len(data))
        if not part:  # hung up: such a port is always readable, and never gives a byte
            raise NotStoppedError("the port is gone")
        data += part
    return data


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
