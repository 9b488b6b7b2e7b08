"""Stop every drive after any death of the daemon.

    python3 neutral.py /dev/truck/drive[=NODE[@BAUD]] /dev/truck/actuators=KIND:WORDS@BAUD ...

One argument for each controller, all stopped at once. Without a KIND it is an EPOS: quick stop, then power stage off;
NODE and BAUD must equal ``driver.node`` and ``port.baud`` of the configuration's drive; left out they are those of the
controller as delivered. Of a VESC WORDS are ``AMPERES:ERPM:ID,...``: it is braked by that current until all motors are
slower than ERPM; an empty ID is the controller that is connected. Steppers (quick stop, then coils off) and boards with
ROSArduinoBridge (voltage off) have no WORDS, those of a speed controller on a Maestro are ``CHANNEL:QUARTERS`` of its
neutral pulse, those of one on a PCA9685 ``ADDRESS:CHANNEL:COUNTS``. Needs nothing but Python's standard library and the
codecs installed with it. Exit code 0 once every controller has stopped, 1 if one did not within five seconds, for
whatever reason.
"""

import contextlib
import os
import select
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

HERE = Path(__file__).resolve()
sys.path += [str(HERE.parents[1] / "drivers"), str(HERE.parents[2])]  # a checkout's, an installation's

from monstertruck_drivers.arduino_bridge import protocol as board
from monstertruck_drivers.epos.protocol import EPOS_BAUD, Frame, FrameError, decode_body, stop_frames
from monstertruck_drivers.i2c import bus as i2c
from monstertruck_drivers.maestro import protocol as maestro
from monstertruck_drivers.pca9685 import protocol as pca9685
from monstertruck_drivers.steppers import protocol as steppers
from monstertruck_drivers.vesc import protocol as vesc

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


AGAIN = 0.02
"""Seconds between two looks at motors that still turn."""


class NotStoppedError(Exception):
    """The controller stayed silent, answered something else, or refused."""


def main(arguments: list[str]) -> int:
    """Entry point; returns the exit code."""
    jobs = [job(argument) for argument in arguments]
    stopped: list[str] = []
    # Daemons: the kernel may hold a port whose device takes no bytes for half a minute.
    threads = [threading.Thread(target=insist, args=(*one, stopped), daemon=True) for one in jobs]
    end = time.monotonic() + TIMEOUT + ATTEMPT
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(max(0.0, end - time.monotonic()))
    return 0 if jobs and len(stopped) == len(jobs) else 1


def job(argument: str) -> tuple[str, Callable[[], None]]:
    """Port that an argument names, and what stops the controller there."""
    port, _, rest = argument.partition("=")
    kind, colon, rest = rest.partition(":")
    if not colon:
        return port, partial(stop, *drive(argument))
    words, _, baud = rest.partition("@")
    others = {
        "vesc": stop_vesc,
        "steppers": stop_steppers,
        "arduino_bridge": stop_board,
        "maestro_esc": stop_esc,
        "pca9685_esc": stop_pca9685,
    }
    return port, partial(others[kind], port, words, int(baud))


def drive(argument: str) -> tuple[str, int, int]:
    """Port, node and baud rate of an EPOS that an argument names."""
    port, _, rest = argument.partition("=")
    node, _, baud = rest.partition("@")
    return port, int(node or 1), int(baud or EPOS_BAUD)


def insist(port: str, work: Callable[[], None], stopped: list[str]) -> None:
    """Try until the controller has stopped or the time-out; adds the port to ``stopped``."""
    give_up = time.monotonic() + TIMEOUT
    while time.monotonic() < give_up:
        try:
            work()
        except (OSError, termios.error, FrameError, steppers.LineError, NotStoppedError) as error:
            print(f"neutral: {port}: {error}", file=sys.stderr)
            time.sleep(FRAME_TIMEOUT)
        else:
            print(f"neutral: {port}: stopped")
            stopped.append(port)
            return


@contextlib.contextmanager
def opened(port: str, baud: int) -> Iterator[int]:
    """Open a port, raw and empty.

    Raises:
        OSError: the port cannot be used.
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
        yield line
    finally:
        os.close(line)


def stop(port: str, node: int, baud: int) -> None:
    """Open the port of an EPOS and make both writes.

    Raises:
        OSError: the port cannot be used.
        NotStoppedError: the controller did not accept a command.
        FrameError: an answer was damaged.
    """
    with opened(port, baud) as line:
        brake, switch_off = stop_frames(node)
        exchange(line, brake)
        time.sleep(BRAKING)  # a motor without power only coasts
        exchange(line, switch_off)


def stop_vesc(port: str, words: str, baud: int) -> None:
    """Brake every motor until all are slow; the current stays on, and so does the brake of the controllers' watchdog.

    Raises:
        OSError: the port cannot be used.
        NotStoppedError: a controller is silent, or its motor still turns.
    """
    amperes, rest, ids = words.split(":")
    motors = [int(one) if one else None for one in ids.split(",")]
    end = time.monotonic() + BRAKING
    with opened(port, baud) as line:
        while True:
            for motor in motors:
                os.write(line, vesc.frame(vesc.forwarded(motor, vesc.set_brake(float(amperes)))))
            fastest = max(abs(speed_of(line, motor)) for motor in motors)
            if fastest <= float(rest):
                return
            if time.monotonic() > end:
                raise NotStoppedError(f"a motor still turns at {fastest} electrical rpm")
            time.sleep(AGAIN)


def speed_of(line: int, motor: int | None) -> int:
    """Electrical speed of a VESC's motor, rpm."""
    os.write(line, vesc.frame(vesc.forwarded(motor, vesc.request(vesc.PacketId.GET_VALUES))))
    deframer = vesc.Deframer()
    while True:
        for payload in deframer.feed(some(line)):
            try:
                values = vesc.MotorValues.of(payload)
            except vesc.PacketError:
                continue
            if motor in (None, values.controller_id):
                return values.erpm


def stop_steppers(port: str, words: str, baud: int) -> None:
    """Quick stop until all motors stand, then coils off.

    Raises:
        OSError: the port cannot be used.
        NotStoppedError: the controller is silent, or a motor still turns.
    """
    del words
    end = time.monotonic() + BRAKING
    with opened(port, baud) as line:
        while any(rates := step_rates(line, "Q")):
            if time.monotonic() > end:
                raise NotStoppedError(f"motors still turn at {rates} steps/s")
            time.sleep(AGAIN)
        step_rates(line, "D")


def stop_board(port: str, words: str, baud: int) -> None:
    """Cut the motors' voltage; wait for a board that restarts because its port was opened.

    Raises:
        OSError: the port cannot be used.
        NotStoppedError: the board is silent.
    """
    del words
    end = time.monotonic() + ATTEMPT
    with opened(port, baud) as line:
        lines = board.BoardLines()
        while time.monotonic() < end:
            os.write(line, board.END + board.speeds(0, 0))
            with contextlib.suppress(NotStoppedError):
                if board.OK in lines.feed(some(line)):
                    return
    raise NotStoppedError("no answer")


def stop_esc(port: str, words: str, baud: int) -> None:
    """Send the neutral pulse to the speed controller on a Maestro, and read it back.

    Raises:
        OSError: the port cannot be used.
        NotStoppedError: the unit is silent, or sends another pulse.
    """
    channel, quarters = map(int, words.split(":"))
    encode = maestro.Encoder()
    with opened(port, baud) as line:
        os.write(line, encode.set_target(channel, quarters))
        time.sleep(AGAIN)
        os.write(line, encode.get_position(channel))
        (position,) = maestro.words(receive(line, 2))
    if position != quarters:
        raise NotStoppedError(f"the pulse is {position / 4} us")


def stop_pca9685(port: str, words: str, baud: int) -> None:
    """Send the neutral pulse to the speed controller on a PCA9685, and read it back.

    Raises:
        OSError: the bus cannot be used, or the chip does not acknowledge.
        NotStoppedError: the chip sends another pulse.
    """
    del baud
    address, channel, counts = map(int, words.split(":"))
    bus = os.open(port, os.O_RDWR)
    try:
        for i, value in enumerate(pca9685.pulse(channel, counts)[1:]):  # one by one: it may not increment
            i2c.transfer(bus, address, bytes((pca9685.register_of(channel) + i, value)))
        present = b"".join(i2c.transfer(bus, address, bytes((pca9685.register_of(channel) + i,)), 1) for i in range(4))
    finally:
        os.close(bus)
    if pca9685.counts_of(present) != counts:
        raise NotStoppedError(f"the pulse is {pca9685.counts_of(present)} counts")


def step_rates(line: int, verb: str) -> list[float]:
    """Send a request to the steppers; returns the rates of its answer, steps/s."""
    os.write(line, bytes(steppers.Line(verb, 0)))
    splitter = steppers.Splitter()
    while True:
        for answer in splitter.feed(some(line)):
            if answer.verb == "s":
                return [rate / 1000 for rate in steppers.Status.of(answer, len(answer.words[3:]) // 2).rates]


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


def some(line: int) -> bytes:
    """Read the next bytes of an answer."""
    if not select.select([line], [], [], 0.25)[0]:
        raise NotStoppedError("no answer")
    data = os.read(line, 4096)
    if not data:
        raise NotStoppedError("the port is gone")
    return data


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
