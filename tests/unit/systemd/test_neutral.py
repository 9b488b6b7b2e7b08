"""The script that stops the drives after any death of the daemon, byte by byte against a controller on a pty."""

import contextlib
import importlib.util
import os
import select
import sys
import termios
import threading
import tty
from pathlib import Path
from types import SimpleNamespace

import pytest

from monstertruck_drivers.epos.protocol import Opcode, answer, decode_body, stop_frames

SCRIPT = Path(__file__).resolve().parents[3] / "systemd" / "neutral.py"
BRAKE, SWITCH_OFF = stop_frames(3)
REFUSED = 0x0F00FFB9


class Controller:
    """The far side of a pty: answers one request after the other.

    Args:
        script: what to do with each request: a code to answer with (0 = accepted), or a fault.
    """

    def __init__(self, *script):
        self.master, slave = os.openpty()
        tty.setraw(slave)
        self.path = os.ttyname(slave)
        self.slave = slave
        self.frames = []
        self.script = list(script)
        self.confirmed = 0
        """Answers that were acknowledged."""
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def _read(self, count):
        data = b""
        while len(data) < count:
            data += os.read(self.master, count - len(data))
        return data

    def _run(self):
        try:
            for step in self.script:
                self._answer(step)
        except OSError:
            return

    def _answer(self, step):
        if (opcode := self._read(1)[0]) == ord("O"):  # a flush of the line may have lost it
            self.confirmed += 1
            opcode = self._read(1)[0]
        if step == "silent":
            return
        os.write(self.master, b"F" if step == "no permission" else b"O")
        if step == "no permission":
            return
        head = self._read(1)
        body = head + self._read(2 * (head[0] + 1) + 2)
        self.frames.append(decode_body(Opcode(opcode), body))
        if step == "damaged request":
            os.write(self.master, b"F")
            return
        os.write(self.master, b"O")
        reply = answer(0 if isinstance(step, str) else step)
        if step == "short answer":
            reply = reply._replace(words=reply.words[:1])
        os.write(self.master, b"\x11" if step == "not an answer" else reply.head)
        if step == "not an answer":
            return
        assert self._read(1) == b"O"
        data = reply.body
        if step == "damaged answer":
            data = data[:-1] + bytes([data[-1] ^ 1])
        for byte in data:  # however it is cut
            os.write(self.master, bytes([byte]))

    def close(self):
        self.thread.join(10.0)
        assert not self.thread.is_alive()
        if select.select([self.master], [], [], 0)[0]:
            self.confirmed += os.read(self.master, 100) == b"O"
        for file in (self.master, self.slave):
            os.close(file)


class Clock:
    """Time that passes by sleeping, and a little by every look."""

    def __init__(self):
        self.now = 100.0
        self.slept = []

    def monotonic(self):
        self.now += 0.01
        return self.now

    def sleep(self, seconds):
        self.slept.append(seconds)
        self.now += seconds


@pytest.fixture
def neutral(monkeypatch):
    spec = importlib.util.spec_from_file_location("neutral", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "time", Clock())
    slower = SimpleNamespace(select=lambda r, w, e, seconds: select.select(r, w, e, 6 * seconds))  # a busy computer
    monkeypatch.setattr(module, "select", slower)
    return module


def run(neutral, *script, node=3):
    controller = Controller(*script)
    code = neutral.main([f"{controller.path}={node}@115200"])
    controller.close()
    return code, controller.frames, neutral.time.slept


def test_every_answer_is_acknowledged(neutral):
    controller = Controller(0, 0)
    neutral.stop(controller.path, 3, 38400)
    controller.close()
    assert controller.confirmed == 2


@pytest.mark.parametrize(
    ("argument", "expected"),
    [
        ("/dev/drive", ("/dev/drive", 1, 38400)),
        ("/dev/drive=5", ("/dev/drive", 5, 38400)),
        ("/dev/drive=5@115200", ("/dev/drive", 5, 115200)),
        ("/dev/drive=@9600", ("/dev/drive", 1, 9600)),
    ],
)
def test_an_argument_names_port_node_and_rate(neutral, argument, expected):
    assert neutral.drive(argument) == expected


def test_a_controller_is_braked_and_switched_off_once_it_had_the_time_to_brake(neutral, capsys):
    code, frames, slept = run(neutral, 0, 0)
    assert (code, frames, slept) == (0, [BRAKE, SWITCH_OFF], [0.4])
    assert "stopped" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        (REFUSED, "refused with error 0x0F00FFB9"),
        (0x00050000, "refused with error 0x00050000"),
        ("no permission", "expected b'O', got b'F'"),
        ("damaged request", "expected b'O', got b'F'"),
        ("not an answer", "expected b'\\x00', got b'\\x11'"),
        ("damaged answer", ""),
        ("short answer", "an answer without a result"),
        ("silent", "no answer"),
    ],
)
def test_whatever_goes_wrong_is_reported_and_tried_again_once_the_controller_has_forgotten_it(
    neutral, fault, says, capsys
):
    code, frames, slept = run(neutral, fault, 0, 0)
    assert code == 0
    assert frames[-2:] == [BRAKE, SWITCH_OFF]
    assert slept == [0.55, 0.4]
    reported = capsys.readouterr()
    assert says in reported.err
    assert reported.err.startswith("neutral: /dev/pts/")


def test_a_port_that_hangs_up_in_the_middle_is_opened_again(neutral, monkeypatch):
    controller, lost = Controller("no permission", 0, 0), iter([True])

    def read(*arguments):
        return b"" if next(lost, False) else os.read(*arguments)

    monkeypatch.setattr(neutral, "os", SimpleNamespace(**vars(os) | {"read": read}))
    assert neutral.main([f"{controller.path}=3@115200"]) == 0
    controller.close()
    assert controller.frames[-2:] == [BRAKE, SWITCH_OFF]


def test_a_controller_that_refuses_to_switch_off_is_braked_again(neutral):
    code, frames, slept = run(neutral, 0, REFUSED, 0, 0)
    assert (code, frames) == (0, [BRAKE, SWITCH_OFF, BRAKE, SWITCH_OFF])
    assert slept == [0.4, 0.55, 0.4]


def test_the_script_gives_up_after_its_time(neutral, capsys):
    code, frames, slept = run(neutral, *[REFUSED] * 9)
    assert (code, set(slept)) == (1, {0.55})
    assert len(slept) == 9
    assert frames == [BRAKE] * 9
    assert "stopped" not in capsys.readouterr().out


def test_without_an_answer_it_waits_a_quarter_of_a_second(neutral, monkeypatch):
    waits = []

    def select(readers, writers, errors, timeout):
        waits.append(timeout)
        return [], [], []

    monkeypatch.setattr(neutral, "select", SimpleNamespace(select=select))
    with pytest.raises(neutral.NotStoppedError, match="no answer"):
        neutral.receive(0, 1)
    assert waits == [0.25]


def test_of_what_comes_in_pieces_no_more_is_read_than_was_asked_for(neutral, monkeypatch):
    reader, writer = os.pipe()
    pieces = [b"ab", b"cde"]

    def arrive(*_):
        os.write(writer, pieces.pop(0))
        return [reader], [], []

    monkeypatch.setattr(neutral.select, "select", arrive)
    assert neutral.receive(reader, 3) == b"abc"
    assert os.read(reader, 9) == b"de"
    os.close(reader)
    os.close(writer)


def test_a_port_that_is_not_there_is_reported_and_a_failure(neutral, tmp_path, capsys):
    assert neutral.main([str(tmp_path / "none")]) == 1
    assert "No such file" in capsys.readouterr().err


def test_what_is_no_line_is_a_failure_and_leaves_nothing_open(neutral, tmp_path):
    (tmp_path / "file").touch()
    before = len(list(Path("/proc/self/fd").iterdir()))
    assert neutral.main([str(tmp_path / "file")]) == 1
    assert len(list(Path("/proc/self/fd").iterdir())) == before


def test_without_a_drive_nothing_was_stopped(neutral):
    assert neutral.main([]) == 1


@pytest.mark.parametrize("second", [0, REFUSED])
def test_every_drive_is_stopped_and_counts(neutral, second):
    one, other = Controller(0, 0), Controller(*([second] * (2 if second == 0 else 30)))
    assert neutral.main([f"{one.path}=3", f"{other.path}=3"]) == (0 if second == 0 else 1)
    assert one.frames == [BRAKE, SWITCH_OFF]
    one.close()
    os.close(other.slave)  # ends what the other still waits for
    other.thread.join(2.0)
    os.close(other.master)


def test_the_line_is_raw_at_its_rate_and_what_was_waiting_on_it_is_forgotten(neutral, monkeypatch):
    controller = Controller(0, 0)
    os.write(controller.master, b"rubbish")
    assert select.select([controller.slave], [], [], 10)[0]  # arrived while the line is raw: no echo for the controller
    cooked = termios.tcgetattr(controller.slave)
    cooked[3] |= termios.ECHO | termios.ICANON
    termios.tcsetattr(controller.slave, termios.TCSANOW, cooked)
    flushed, closed = [], []
    monkeypatch.setattr(neutral.termios, "tcflush", lambda line, queue: flushed.append(queue))
    settings = {}
    exchange = neutral.exchange

    def look(line, frame):
        settings.update(
            zip(("in", "out", "control", "local", "ispeed", "ospeed"), termios.tcgetattr(line), strict=False)
        )
        while neutral.select.select([line], [], [], 0)[0]:
            os.read(line, 100)
        return exchange(line, frame)

    monkeypatch.setattr(neutral, "exchange", look)
    close = os.close
    monkeypatch.setattr(neutral.os, "close", lambda line: (closed.append(line), close(line)))
    neutral.stop(controller.path, 3, 115200)
    monkeypatch.undo()
    assert flushed == [termios.TCIOFLUSH]
    assert (settings["ispeed"], settings["ospeed"]) == (termios.B115200, termios.B115200)
    assert not settings["local"] & (termios.ECHO | termios.ICANON)
    assert len(closed) == 1
    controller.close()


def test_the_codec_is_looked_for_in_a_checkout_and_in_an_installation(neutral):
    assert sys.path[-2:] == [str(SCRIPT.parents[1] / "drivers"), str(SCRIPT.parents[2])]


def test_a_port_that_the_kernel_does_not_let_go_of_does_not_keep_the_script(neutral, monkeypatch):
    controller, lets_go = Controller(0, 0), threading.Event()
    monkeypatch.setattr(neutral, "os", SimpleNamespace(**vars(os) | {"close": lambda _: lets_go.wait(30)}))
    monkeypatch.setattr(neutral, "TIMEOUT", 0.2)
    monkeypatch.setattr(neutral, "ATTEMPT", 1.0)
    waiting = threading.Thread(target=neutral.main, args=([f"{controller.path}=3"],))
    waiting.start()
    waiting.join(10)
    still = waiting.is_alive()
    lets_go.set()
    waiting.join()
    assert not still
    assert len(controller.frames) == 2, "both commands were given"


def ended(monkeypatch, *arguments):
    """Exit code of the script run as a program."""
    monkeypatch.setattr(sys, "argv", [str(SCRIPT), *arguments])
    spec = importlib.util.spec_from_file_location("__main__", SCRIPT)
    with pytest.raises(SystemExit) as end:
        spec.loader.exec_module(importlib.util.module_from_spec(spec))
    return end.value.code


def test_as_a_program_it_ends_with_the_code_and_needs_the_ports(monkeypatch):
    assert ended(monkeypatch) == 1
    controller = Controller(0, 0)
    assert ended(monkeypatch, f"{controller.path}=3") == 0
    controller.close()


def test_a_line_without_a_carrier_holds_up_nothing(neutral, monkeypatch):
    """As an adapter is that was plugged in anew since the daemon opened it."""
    controller = Controller(0, 0)
    settings = termios.tcgetattr(controller.slave)
    settings[2] &= ~termios.CLOCAL
    termios.tcsetattr(controller.slave, termios.TCSANOW, settings)
    flags = []
    opened = os.open
    monkeypatch.setattr(neutral.os, "open", lambda path, how: (flags.append(how), opened(path, how))[1])
    assert neutral.main([f"{controller.path}=3@115200"]) == 0
    assert flags[0] & os.O_NONBLOCK
    assert termios.tcgetattr(controller.slave)[2] & termios.CLOCAL
    controller.close()


def test_a_board_that_stays_silent_is_given_up_after_its_time(neutral, monkeypatch):
    now, asked = [1000.0], []

    def silent(line):
        asked.append(line)
        now[0] += 0.25
        raise neutral.NotStoppedError("no answer")

    monkeypatch.setattr(neutral, "time", SimpleNamespace(monotonic=lambda: now[0]))
    monkeypatch.setattr(neutral, "some", silent)
    monkeypatch.setattr(neutral, "opened", lambda port, baud: contextlib.nullcontext(0))
    monkeypatch.setattr(neutral, "os", SimpleNamespace(write=lambda line, data: None))
    with pytest.raises(neutral.NotStoppedError, match="no answer"):
        neutral.stop_board("board", "", 57600)
    assert len(asked) == neutral.ATTEMPT / 0.25
