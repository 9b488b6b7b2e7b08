"""Follow a robot for the live screen."""

import asyncio
import json

from rich.console import Console
from rich.live import Live

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.endpoints import robot_on_host
from monstertruck_runtime.errors import NoAnswerError, NotFoundError
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_schemas import topics
from monstertruck_schemas.base import Message
from monstertruck_schemas.sensor import SonarEcho
from monstertruckd.tools.status.screen import SHOWN, ScreenState, calibration_badge, draw

PICTURED = frozenset({topics.SCAN.name, topics.TRANSFORMS.name})
"""Topics shown only in the scan view, not in words."""
SCREEN_PERIOD = 0.1


class Follower:
    """Keeps a ``ScreenState`` up to date from a client's subscriptions.

    Args:
        client: connected client.
        clock: clock of the station.
        state: state to update; None creates one.
    """

    def __init__(self, client: TruckClient, clock: Clock, state: ScreenState | None = None) -> None:
        self.state = state or ScreenState(robot_on_host(client.robot, client.endpoint), clock.now())
        self._clock = clock
        self._newest = [client.subscribe(topic, latest()) for topic in SHOWN.values()]
        self._events = client.subscribe(topics.EVENT, fifo(64))

    async def run(self) -> None:
        """Follow until cancelled."""
        await asyncio.gather(self._sample(), self._collect())

    async def _sample(self) -> None:
        taken: dict[int, Message] = {}
        while True:
            now = self._clock.now()
            for number, mailbox in enumerate(self._newest):
                message = mailbox.latest
                if message is not None and message is not taken.get(number):
                    taken[number] = message
                    self.state.take(message)
                    self.state.heard = now
            self.state.silence = (now - self.state.heard) / SECOND
            await self._clock.sleep(SCREEN_PERIOD / 2)

    async def _collect(self) -> None:
        async for event in self._events:
            self.state.take(event, self._clock.now() + self._clock.real_offset())


async def watch(clock: Clock, robot: str, endpoint: str) -> None:
    """Draw the screen until cancelled; wait for a robot that is absent or disappears."""
    state = ScreenState(robot_on_host(robot, endpoint), clock.now())
    following = asyncio.create_task(_follow(clock, robot, endpoint, state))
    try:
        with Live(console=Console(), screen=True, auto_refresh=False) as live:
            while not following.done():
                live.update(draw(state, live.console.width), refresh=True)
                await clock.sleep(SCREEN_PERIOD)
        following.result()
    finally:
        following.cancel()
        await asyncio.wait([following])


async def _follow(clock: Clock, robot: str, endpoint: str, state: ScreenState) -> None:
    while True:
        try:
            # 1.0: timeout of the robot's answer (s)
            async with TruckClient(robot, endpoint, clock=clock, timeout=1.0) as client:
                state.trouble = ""
                await Follower(client, clock, state).run()
        except NotFoundError as error:
            state.trouble = str(error)
            state.silence = (clock.now() - state.heard) / SECOND
            await clock.sleep(SCREEN_PERIOD)


async def print_once(clock: Clock, robot: str, endpoint: str, *, json_output: bool) -> None:
    """Print the robot's state once.

    Raises:
        NoAnswerError: the robot published no message within a second.
    """
    async with TruckClient(robot, endpoint, clock=clock) as client:
        boxes = {topic.name: client.subscribe(topic, latest()) for topic in SHOWN.values()}
        await clock.sleep(1.2)
        newest: dict[str, Message] = {name: box.latest for name, box in boxes.items() if box.latest is not None}
        if not newest:
            raise NoAnswerError(f"robot {robot!r} at {endpoint} published no message within a second")
        if json_output:
            rows = {name: m.model_dump(mode="json") for name, m in newest.items() if name not in PICTURED}
            print(json.dumps(rows, indent=2))
            return
        state = ScreenState(robot, clock.now())
        for message in newest.values():
            state.take(message)
        for line in plain(state):
            print(line)


def _echo(echo: SonarEcho) -> str:
    """Return one sonar in words: ``fl 0.42 m``."""
    distance = "no echo" if echo.range is None else f"{echo.range:.2f} m"
    return f"{echo.name} {distance if echo.answered else 'silent'}"


def _steering(state: ScreenState) -> list[str]:
    """Return the calibration state and the steering difference that the tracker has learnt."""
    health, tracker = state.calibration, state.tracker
    rows = [
        ("calibrated", "" if health is None else calibration_badge(health)),
        ("proposed ", "" if health is None else health.proposed),
        ("steering ", "" if tracker is None else tracker.steering_differs),
    ]
    return [f"{name} {text}" for name, text in rows if text]


def plain(state: ScreenState) -> list[str]:
    """Return the state in words, for pipes."""
    lines = []
    if state.gate is not None:
        reasons = ", ".join(reason.value for reason in state.gate.reasons) or "-"
        lines.append(f"gate      {state.gate.mode_text}, driver {state.gate.holder or '-'}, why {reasons}")
        lines += [f"waiting   {name}" for name in state.gate.waiting]
        lines += [f"weakened  {setting}" for setting in state.gate.weakened]
    lines += [f"stop      {line}" for line in state.why_stopped]
    if state.odometry is not None:
        pose = state.odometry.pose
        lines.append(f"pose      x {pose.x:.3f} m, y {pose.y:.3f} m, yaw {pose.yaw:.3f} rad in {state.odometry.frame}")
    if state.battery is not None:
        volts = "-" if state.battery.voltage is None else f"{state.battery.voltage:.2f}"
        lines.append(f"battery   {volts} V, {state.battery.level.value}")
    if state.sonar is not None:
        lines.append(f"sonars    {', '.join(map(_echo, state.sonar.sonars))}")
    lines += _steering(state)
    if state.loop is not None:
        late = state.loop
        lines.append(f"tick      late p99 {late.lateness_p99 * 1e3:.2f} ms, max {late.lateness_max * 1e3:.2f} ms")
        lines += [f"busy      {late.busy}"] if late.busy else []
    if state.recorder is not None and state.recorder.lost:
        lines.append(f"recorder  {state.recorder.lost}")
    services = state.health.services if state.health is not None else ()
    return lines + [f"service   {s.name:12} {s.state.value:9} restarts {s.restarts} {s.detail}" for s in services]
