"""Session of ``drive``: sends a terminal's keys as drive requests, and shows the robot's state on the terminal."""

import asyncio
import math
import os
import signal
import termios
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from typing import IO, Any, Final

from rich.console import Console, RenderableType
from rich.layout import Layout
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import TruckError
from monstertruck_runtime.readable import when_readable
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order, Role
from monstertruck_schemas.state import GateMode, GateState
from monstertruck_schemas.topics import GATE
from monstertruckd.tools.driving.gamepad import Action, PadMapping, key_for
from monstertruckd.tools.driving.gamepad_device import PadLink
from monstertruckd.tools.driving.modes import SteeringMode
from monstertruckd.tools.driving.teleop import MODE_KEYS, STEERING_KEY_STEPS, Command, KeyReader, Teleop, TeleopRequest
from monstertruckd.tools.status import screen
from monstertruckd.tools.status.screen import ScreenState
from monstertruckd.tools.status.watch import SCREEN_PERIOD, Follower

REQUEST_RATE: Final = 20.0
"""Drive requests per second."""
NEUTRAL_REQUESTS: Final = 6
"""Number of neutral requests after the gamepad was let go, so that the truck stops by its ramp."""
QUIET: Final = frozenset({Reason.CLIPPED, Reason.SERVO_LIMIT, Reason.ASSISTED})
"""Limits caused by the driver's request, which the driver already knows."""
HELP = "Enter arm  WASD drive  space E-STOP  Esc stop  r reset  x straight  q end"
ARROWS = {1: "▲ forward", -1: "▼ back", 0: "standing"}
HINTS = {
    None: "no gate state received yet",
    GateMode.DISARMED: "disarmed: Enter arms",
    GateMode.ESTOPPED: "emergency stop: r resets, then Enter arms",
}
REPORT_ON: Final = b"\x1b[?1004h\x1b[?2004h"
"""Enable focus reports and bracketed paste (xterm; other terminals ignore it)."""
REPORT_OFF: Final = b"\x1b[?1004l\x1b[?2004l"

_LOCAL, _INPUT, _CHARACTERS = 3, 0, 6


@dataclass(slots=True)
class Stream:
    """State of the requests to the robot."""

    request: TeleopRequest | None = None
    """Latest request sent; None without a request."""
    round_trip: float | None = None
    """Round-trip time to the robot (s); None without an answer."""
    trouble: str = ""
    """Reason why requests cannot be sent."""
    refusal: str = ""
    """Reason for the refusal of the latest order."""
    pad: str = ""
    """Name of the gamepad, or why it is missing; empty if the session uses no gamepad."""


class DriveSession:
    """Session of one terminal that drives one robot.

    Args:
        teleop: state of keyboard driving.
        clock: clock of the session.
        keyboard: terminal to read from.
        screen: terminal to draw on.
        gamepad: mapping of the gamepad; None for keys only.
    """

    def __init__(
        self, teleop: Teleop, clock: Clock, keyboard: IO[Any], screen: IO[Any], gamepad: PadMapping | None = None
    ) -> None:
        self._teleop = teleop
        self._clock = clock
        self._keyboard = keyboard
        self._screen = screen
        self._reader = KeyReader()
        self._commands: asyncio.Queue[Command] = asyncio.Queue()
        self._stream = Stream()
        self._arming: asyncio.TimerHandle | None = None
        self._gamepad = None if gamepad is None else PadLink(gamepad, clock, self._act)
        self._resting = 0
        """Number of neutral requests still to send after the gamepad was let go."""

    async def run(self, robot: str, endpoint: str) -> None:
        """Drive until the user quits or the terminal is gone; then restore the terminal and stop the truck.

        Raises:
            NotFoundError: no robot answers at the endpoint.
        """
        loop = asyncio.get_running_loop()
        async with TruckClient(robot, endpoint, role=Role.KEYBOARD, clock=self._clock) as client:
            follower = Follower(client, self._clock)
            with every_key(self._keyboard, self._screen):
                when_readable(self._keyboard.fileno(), self._read)
                loop.add_signal_handler(signal.SIGHUP, self._commands.put_nowait, "end")
                try:
                    await self._until_the_end(client, follower)
                finally:
                    loop.remove_reader(self._keyboard)
                    loop.remove_signal_handler(signal.SIGHUP)
                    await self._stop(client)

    async def _until_the_end(self, client: TruckClient, follower: Follower) -> None:
        jobs = [self._ask(client), self._ping(client), self._draw(follower), follower.run()]
        if self._gamepad is not None:
            jobs += [self._gamepad.run(), self._feel(self._gamepad, follower)]
        tasks = [asyncio.create_task(job) for job in (self._obey(client), *jobs)]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.wait(tasks)

    def _read(self) -> None:
        try:
            data = os.read(self._keyboard.fileno(), 4096)
        except OSError:  # the terminal is gone
            data = b""
        if not data:
            asyncio.get_running_loop().remove_reader(self._keyboard)
            self._commands.put_nowait("end")
        self._press(self._reader.feed(data))

    def _press(self, keys: list[str]) -> None:
        for key in keys:
            command = self._teleop.press(key, self._clock.now())
            if command is Order.ARM:
                if self._arming is None:
                    # 0.15: duration of neutral requests before an arm order (s), so that no tracker starts to drive
                    self._arming = asyncio.get_running_loop().call_later(0.15, self._arm)
            elif command is not None:
                self._hold_arming()
                self._commands.put_nowait(command)
            elif key == "focus out":
                self._hold_arming()

    def _arm(self) -> None:
        self._arming = None
        self._commands.put_nowait(Order.ARM)

    def _hold_arming(self) -> None:
        """Cancel an arm order that has not been sent yet."""
        if self._arming is not None:
            self._arming.cancel()
            self._arming = None

    async def _obey(self, client: TruckClient) -> None:
        """Send the keys' orders without waiting for outcomes; return when the user quits."""
        outcomes: set[asyncio.Task[GateState]] = set()
        try:
            while (command := await self._commands.get()) != "end":
                self._stream.refusal = ""
                # Send the order itself here: a task cancelled at the end may never start.
                outcome = asyncio.create_task(client.order(command))
                outcomes.add(outcome)
                outcome.add_done_callback(partial(self._show_outcome, command))
                outcome.add_done_callback(outcomes.discard)
        finally:
            for outcome in outcomes:
                outcome.cancel()

    def _show_outcome(self, order: Order, outcome: asyncio.Task[GateState]) -> None:
        if not outcome.cancelled() and (error := outcome.exception()) is not None:
            self._stream.refusal = f"{order.value} refused: {error}"

    async def _ask(self, client: TruckClient) -> None:
        """Send requests while keys are held, as a deadman switch."""
        before = self._clock.now()
        while True:
            await self._clock.sleep(1.0 / REQUEST_RATE)
            now = self._clock.now()
            # 0.3: maximum pause of this program (s); after a longer one, keys read late may already be released
            if now - before > 0.3 * SECOND:
                self._forget()
            before = now
            self._press(self._reader.flush())
            await self._request(client, *self._input(now))

    def _input(self, now: int) -> tuple[TeleopRequest | None, Role]:
        """Return the current input: a held gamepad has priority over the keys."""
        link = self._gamepad
        pad = None if link is None else link.pad
        self._stream.pad = "" if link is None else link.hint or ("" if pad is None else pad.name)
        if pad is not None and pad.held:
            self._resting = NEUTRAL_REQUESTS
        elif self._resting > 0:
            self._resting -= 1
        else:
            return self._teleop.request(now), Role.KEYBOARD
        if pad is None:
            return TeleopRequest(0.0, 0.0, 0.0), Role.GAMEPAD
        return pad.motion(self._teleop.mode, self._teleop.speed, self._teleop.angle), Role.GAMEPAD

    def _act(self, action: Action) -> None:
        self._press([key_for(action, self._teleop.mode)])

    async def _feel(self, link: PadLink, follower: Follower) -> None:
        """Rumble when a limit starts, harder when the truck stops."""
        before: frozenset[Reason] = frozenset()
        mode: GateMode | None = None
        while True:
            await self._clock.sleep(1.0 / REQUEST_RATE)
            gate = follower.state.gate
            if gate is None:
                continue
            limits = frozenset(gate.reasons) - QUIET
            if gate.mode is not mode and gate.mode in (GateMode.STOPPING, GateMode.ESTOPPED):
                link.rumble(1.0, 0.5)
            elif limits - before and gate.mode is GateMode.DRIVING:
                link.rumble(0.5, 0.2)
            before, mode = limits, gate.mode

    async def _request(self, client: TruckClient, request: TeleopRequest | None, role: Role = Role.KEYBOARD) -> None:
        self._stream.request = request
        if request is None:
            return
        client.role = role
        lease = 0.25  # validity of a request (s)
        try:
            if request.twist is None:
                await client.drive(request.speed, request.front, request.rear, lease=lease, unseen=request.unseen)
            else:
                await client.drive_twist(*request.twist, lease=lease, unseen=request.unseen)
        except TruckError as error:  # shown: the robot may come back
            self._stream.trouble = str(error)
        else:
            self._stream.trouble = ""

    def _forget(self) -> None:
        forget_input(self._keyboard)
        self._reader.clear()
        self._hold_arming()
        self._teleop.release()
        if self._gamepad is not None:
            self._gamepad.flush()

    async def _ping(self, client: TruckClient) -> None:
        while True:
            sent = self._clock.now()
            try:
                await client.get_retained(GATE)
                self._stream.round_trip = (self._clock.now() - sent) / SECOND
            except TruckError:
                self._stream.round_trip = None
            await self._clock.sleep(1.0)  # interval between measurements of the round trip (s)

    async def _draw(self, follower: Follower) -> None:
        """Show the state; return when the terminal is gone, even if the keyboard notices it later."""
        console = Console(file=self._screen)
        with suppress(OSError), Live(console=console, screen=True, auto_refresh=False) as live:
            while True:
                live.update(draw(follower.state, self._teleop, self._stream, console.width), refresh=True)
                await self._clock.sleep(SCREEN_PERIOD)

    async def _stop(self, client: TruckClient) -> None:
        with suppress(TruckError, TimeoutError):
            async with self._clock.deadline(1.0):  # maximum wait for the truck to stop at the end (s)
                await client.stop()


def draw(state: ScreenState, teleop: Teleop, stream: Stream, width: int) -> RenderableType:
    """Return the whole screen."""
    layout = Layout()
    layout.split_column(
        Layout(_controls(state, teleop, stream), size=6), Layout(screen.draw(state, width, events=4), ratio=1)
    )
    return layout


def _controls(state: ScreenState, teleop: Teleop, stream: Stream) -> Panel:
    table = Table.grid(padding=(0, 1))
    steering = _twist(stream) if teleop.mode is SteeringMode.TWIST else _wheels(teleop)
    table.add_row(_asked(stream), Text(f"{teleop.speed:.2f} m/s (+/-)", style="bold"), steering, _link(stream))
    body = Table.grid()
    body.add_row(table)
    body.add_row(_modes(teleop))
    body.add_row(Text(HELP, style="dim", no_wrap=True, overflow="ellipsis"))
    body.add_row(_message(state, stream))
    title = "drive: the robot moves only while a key is held" + (f" · {stream.pad}" if stream.pad else "")
    return Panel(body, title=title, border_style="dim")


def _message(state: ScreenState, stream: Stream) -> Text:
    """Return the current error, or the key to press before anything moves."""
    if text := stream.trouble or stream.refusal:
        return Text(text, style="bold red", no_wrap=True, overflow="ellipsis")
    mode = None if state.gate is None else state.gate.mode
    return Text(HINTS.get(mode, ""), style="bold yellow")


def _asked(stream: Stream) -> Text:
    if stream.request is None:
        return Text("silent    ", style="dim")
    speed, *others = stream.request.twist or (stream.request.speed,)
    moving = speed or any(others)
    text = "turn, side" if any(others) and not speed else ARROWS[(speed > 0) - (speed < 0)]
    return Text(f"{text:10}", style="bold green" if moving else "cyan")


def _wheels(teleop: Teleop) -> Text:
    cells = ["─"] * (2 * STEERING_KEY_STEPS + 1)
    at = round(STEERING_KEY_STEPS * (1.0 - teleop.steer / teleop.angle))
    cells[STEERING_KEY_STEPS], cells[at] = "┼", "●"
    return Text(f"{''.join(cells)} {math.degrees(teleop.steer):+5.1f}°")


def _twist(stream: Stream) -> Text:
    vx, vy, wz = (None if stream.request is None else stream.request.twist) or (0.0, 0.0, 0.0)
    return Text(f"ahead {vx:+.2f} left {vy:+.2f} m/s turn {math.degrees(wz):+.0f}°/s")


def _link(stream: Stream) -> Text:
    if stream.round_trip is None:
        return Text("no answer", style="bold red")
    return Text(f"round trip {stream.round_trip * 1e3:.1f} ms")


def _modes(teleop: Teleop) -> Text:
    text = Text(no_wrap=True)
    for key, mode in MODE_KEYS.items():
        text.append(f"{key} {mode.value}  ", style="reverse" if mode is teleop.mode else "dim")
    if teleop.mode is SteeringMode.HYBRID:
        text.append(f"z/c drift {math.degrees(teleop.drift):+.1f}°", style="bold")
    if teleop.mode is SteeringMode.TWIST:
        text.append("a/d turn z/c left, right", style="bold")
    return text


@contextmanager
def every_key(keyboard: IO[Any], screen: IO[Any]) -> Iterator[None]:
    """Deliver keys one by one without echo; Ctrl-C still interrupts, Ctrl-Z and Ctrl-S neither suspend nor freeze.

    Args:
        keyboard: terminal to read from.
        screen: terminal to write to.
    """
    before = termios.tcgetattr(keyboard)
    changed = termios.tcgetattr(keyboard)
    changed[_LOCAL] &= ~(termios.ICANON | termios.ECHO)
    changed[_INPUT] &= ~termios.IXON
    changed[_CHARACTERS][termios.VSUSP] = b"\x00"
    termios.tcsetattr(keyboard, termios.TCSADRAIN, changed)
    try:
        os.write(screen.fileno(), REPORT_ON)
        yield
    finally:
        _restore(keyboard, screen, before)


def _restore(keyboard: IO[Any], screen: IO[Any], before: list[Any]) -> None:
    with suppress(OSError):  # a terminal that is gone took its settings along
        os.write(screen.fileno(), REPORT_OFF)
    with suppress(termios.error):
        # Held keys must not reach the shell.
        termios.tcsetattr(keyboard, termios.TCSAFLUSH, before)


def forget_input(keyboard: IO[Any]) -> None:
    """Discard typed keys that have not been read yet."""
    with suppress(termios.error):
        termios.tcflush(keyboard, termios.TCIFLUSH)
