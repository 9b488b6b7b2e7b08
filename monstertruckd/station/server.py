"""Web server of the station: one page, its files, maps by URL, and one WebSocket per browser."""

import asyncio
import itertools
import json
import logging
import re
import secrets
import shutil
import ssl
import tempfile
from collections.abc import Awaitable, Callable, Coroutine, Iterable, Sequence
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from aiohttp import WSCloseCode, WSMessage, WSMsgType, web
from aiohttp.http_exceptions import HttpProcessingError

from monstertruck_runtime.clock import Clock
from monstertruck_runtime.endpoints import LOCAL_HOSTS
from monstertruck_runtime.errors import BusyError, InputError, NotPermittedError, TruckError
from monstertruck_runtime.threads import in_thread
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import UNCONDITIONAL
from monstertruck_schemas.roles import AccessRole
from monstertruckd import __version__
from monstertruckd.station import commands, frames
from monstertruckd.station.address import RobotAddress
from monstertruckd.station.calibration import Calibration, Calibrator
from monstertruckd.station.commands import (
    Calibrate,
    ControlReplay,
    EchoRequest,
    Heartbeat,
    InjectFault,
    ListNumbers,
    LookAtFleet,
    PlaceObstacle,
    PlotNumbers,
    ReplayRecording,
    Watch,
)
from monstertruckd.station.discovery import Discovery
from monstertruckd.station.downloads import download, fetch
from monstertruckd.station.emulated import EmulatedWorld
from monstertruckd.station.feed import RobotFeed
from monstertruckd.station.fleet import FleetBoard
from monstertruckd.station.listener import WebListener
from monstertruckd.station.pilot import Pilot
from monstertruckd.station.plots import numbers, require_numbers
from monstertruckd.station.remarks import Remarks
from monstertruckd.station.replay import LogOpener, ReplayFeed
from monstertruckd.station.users import LOCAL, StationUser, StationUsers, network_of
from monstertruckd.station.viewer import Viewer

CHECK_PERIOD: Final = 1.0
"""Time between checks for new robots, revoked users and too many connections (s)."""
MOST_BROWSERS: Final = 32
"""Maximum number of browsers: each holds a session with a robot, which accepts a limited number."""
MOST_OF_USER: Final = 8
"""Maximum number of browsers of one user who logs in."""
MOST_CONNECTIONS: Final = 256
"""Maximum number of connections of one network; later ones are closed. A browser keeps about six."""
log = logging.getLogger(__name__)

PAGE: Final = Path(__file__).parent / "page"
FILES: Final = re.compile(r"[a-z_]+\.(?:js|css|svg)")
MOST_REPLAYS: Final = 4
"""Maximum number of recordings shown, and kept in memory, at once."""
RECORDING: Final = re.compile(r"[A-Za-z0-9_.-]{1,120}\.mcap")
TYPES: Final = {".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml", ".html": "text/html"}
END: Final = 5.0
"""Maximum time to close the sessions with robots at shutdown (s)."""
LANGUAGE: Final = "en"
MESSAGES: Final = 200.0
"""Rate limit of one browser (messages/s), and its burst size; faster messages wait without delaying other browsers."""
USUAL_PORTS: Final = {"http": 80, "https": 443}
"""Default ports, which browsers omit from a host name."""

OWN_SITE: Final = ("same-origin", "none")
"""Values of the Sec-Fetch-Site header for requests of the page itself or the user."""
HEADERS: Final = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob: data:; frame-ancestors 'none'; "
    "base-uri 'none'; form-action 'self'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
}

USER: Final = web.RequestKey("user", StationUser)

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


@dataclass(frozen=True, slots=True)
class Place:
    """Listening address of the page; TLS and users who log in are required for an address other than loopback.

    Raises:
        NotPermittedError: ``host`` is not a loopback address, and the certificate or the users are missing.
    """

    host: str = "127.0.0.1"
    port: int = 8470
    tls: ssl.SSLContext | None = None
    users: StationUsers | None = None
    aliases: tuple[str, ...] = ()
    """Further names of this machine that browsers may use for the page."""

    def __post_init__(self) -> None:
        if self.host not in LOCAL_HOSTS and (self.tls is None or self.users is None):
            raise NotPermittedError(
                f"host {self.host}: a page reachable from other machines needs a certificate with its key, and users"
            )

    @property
    def url(self) -> str:
        """Address of the page for a browser."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.scheme}://{host}:{self.port}/"

    @property
    def scheme(self) -> str:
        """Scheme of the page's address."""
        return "http" if self.tls is None else "https"

    @property
    def names(self) -> frozenset[str]:
        """Accepted values of the Host header; requests under other names that resolve to this machine are refused."""
        own = f"[{self.host}]" if ":" in self.host else self.host
        names = {name.lower() for name in (own, *self.aliases, "localhost", "127.0.0.1", "[::1]")}
        usual = names if self.port == USUAL_PORTS[self.scheme] else ()
        return frozenset((*(f"{name}:{self.port}" for name in names), *usual))

    @property
    def origins(self) -> frozenset[str]:
        """Accepted values of the Origin header; a different scheme means a different page."""
        return frozenset(f"{self.scheme}://{name}" for name in self.names)


class Station:
    """Server of the page, with the feeds of robots and recordings.

    Args:
        robots: robots to show; the first is shown at the start.
        clock: clock of the station.
        place: address to listen on.
        routers: endpoints whose robots are shown as they appear.
        open_log: function that opens recordings for replay; None disables replay.
        emulated: receives faults and obstacles of an emulated robot; None if this program emulates no robot.
        calibrator: the calibration wizards; None disables calibration.
    """

    def __init__(
        self,
        robots: Sequence[RobotAddress],
        clock: Clock,
        place: Place = Place(),
        routers: Sequence[str] = (),
        open_log: LogOpener | None = None,
        emulated: EmulatedWorld | None = None,
        calibrator: Calibrator | None = None,
    ) -> None:
        self._clock = clock
        self._emulated = emulated
        self.calibrator = calibrator
        self.place = place
        self.feeds = {address.name: RobotFeed(address, clock) for address in robots}
        if len(self.feeds) != len(robots):
            raise InputError("two robots have the same name: expected a different name for each")
        self._board = FleetBoard(self.feeds, clock)
        self._discoveries = [Discovery(endpoint, clock, self._found) for endpoint in routers]
        self._following: dict[RobotFeed | ReplayFeed, asyncio.Task[None]] = {}
        self._viewers: set[Viewer] = set()
        self._sockets: dict[web.WebSocketResponse, tuple[StationUser, asyncio.Transport | None]] = {}
        self._closing: set[asyncio.Task[None]] = set()
        self._remarks = Remarks(log)
        self._numbers = itertools.count(1)
        self._browsers: list[_Browser] = []
        self._run = secrets.token_hex(2)
        """Token of this run in browser names: the robot remembers the sequence numbers of other runs' browsers."""
        self._strings = _strings()
        self._open_log = open_log
        self.replays: dict[str, ReplayFeed] = {}
        """Shown recordings, by their name in the list of robots."""
        self._folder: Path | None = None
        """Folder of fetched recordings while the server runs."""
        self._fetching = asyncio.Lock()

    async def run(self, ready: Callable[[], object] = lambda: None) -> None:
        """Serve until cancelled; call ``ready`` as soon as browsers can connect.

        Raises:
            BusyError: the port is in use.
        """
        http = logging.getLogger(f"{__name__}.http")
        http.addFilter(self._refuse_rubbish)
        runner = web.AppRunner(self.application(), access_log=None, shutdown_timeout=END, logger=http)
        await runner.setup()
        for feed in self.feeds.values():
            self._follow(feed)
        runs = (self._board.run(), *(each.run() for each in self._discoveries))
        discovering = [asyncio.create_task(run) for run in runs]
        assert runner.server is not None
        place, listening = self.place, AsyncExitStack()
        listener = WebListener(place.host, place.port, place.tls, runner.server, self._remarks.add)
        try:
            try:
                await listening.enter_async_context(listener)
            except OSError as error:
                raise BusyError(f"{place.url} cannot be served: {error.strerror or error}") from None
            ready()
            while True:  # meanwhile robots may appear and users may be removed
                done, _ = await asyncio.wait(
                    [*self._following.values(), *discovering], return_when=asyncio.FIRST_COMPLETED, timeout=CHECK_PERIOD
                )
                for task in done:
                    if not task.cancelled():  # its recording was dropped
                        task.result()
                await self._check_users()
                self._close_crowds(runner.server)
        finally:
            await listening.aclose()
            tasks = [*self._following.values(), *discovering]
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            await runner.cleanup()
            http.removeFilter(self._refuse_rubbish)
            self._remarks.tell()
            if self._folder is not None:
                shutil.rmtree(self._folder, ignore_errors=True)

    async def _check_users(self) -> None:
        """Disconnect browsers whose user was removed or has another role or password."""
        users = self.place.users
        if users is not None and await users.refresh():
            for socket, (user, transport) in self._sockets.items():
                if not users.stands(user):
                    text = "browser of %s disconnected: the user was removed, or has another role or password"
                    log.warning(text, user.name)
                    task = asyncio.create_task(_let_go(socket, transport, WSCloseCode.POLICY_VIOLATION))
                    self._closing.add(task)
                    task.add_done_callback(self._closing.discard)

    def _close_crowds(self, server: web.Server) -> None:
        """Close excess connections from one network, even before a login, to protect the file descriptors."""
        of_peer: dict[str, int] = {}
        for connection in server.connections:  # the oldest first
            peer = _peer(connection)
            of_peer[peer] = of_peer.get(peer, 0) + 1
            if of_peer[peer] > MOST_CONNECTIONS and connection.transport is not None:
                connection.transport.abort()
        for peer, count in of_peer.items():
            if count > MOST_CONNECTIONS:
                self._remarks.add(peer, f"{count} connections from {peer}: {count - MOST_CONNECTIONS} are closed")

    def _follow(self, feed: RobotFeed | ReplayFeed) -> None:
        """Follow a feed, and offer it in every browser."""
        self._following[feed] = asyncio.create_task(feed.run())
        for viewer in self._viewers:
            viewer.send(frames.text("robots", names=self.names))

    def _unwatched(self) -> str:
        """Return the oldest recording that no browser watches.

        Raises:
            InputError: all recordings are being watched.
        """
        name = next((name for name, feed in self.replays.items() if not feed.watched), None)
        if name is None:
            raise InputError(f"{MOST_REPLAYS} recordings are already being replayed: close one first")
        return name

    def _drop_replay(self, name: str) -> None:
        """Stop showing a recording."""
        self._following.pop(self.replays.pop(name)).cancel()

    @property
    def names(self) -> list[str]:
        """Names that browsers can watch: robots first, then recordings."""
        return [*self.feeds, *self.replays]

    async def replay(
        self, address: RobotAddress, name: str, user: str, viewer: Viewer, stamp: int | None = None
    ) -> str:
        """Fetch a recording and offer it in every browser, at a moment (ns, robot's clock) if given; return its name.

        Raises:
            InputError: the name is invalid, the recording cannot be shown or does not contain the moment, or too many
                recordings are already shown.
            TruckError: the robot refuses, or is absent.
        """
        title = f"{address.name} {name.removesuffix('.mcap')}"
        if self._open_log is None or not RECORDING.fullmatch(name):
            raise InputError(f"{name}: cannot be replayed here")
        async with self._fetching:
            shown = self.replays.get(title)
            if shown is not None and stamp is not None and not shown.watched and not shown.holds(stamp):
                self._drop_replay(title)  # fetched while it was being written: it has grown
                shown = None
            if shown is not None:
                return self._at_moment(shown, stamp)
            if len(self.replays) >= MOST_REPLAYS:
                self._drop_replay(self._unwatched())
            if self._folder is None:
                self._folder = Path(tempfile.mkdtemp(prefix="monstertruckd-station-"))
            file, open_log = self._folder / f"{address.name}-{name}", self._open_log

            def progress(share: float) -> None:
                viewer.show("fetching", frames.text("fetching", name=name, share=round(share, 3)))

            fetched = await fetch(address, name, user, self._clock, file, progress)
            try:
                feed = await in_thread(lambda: ReplayFeed(title, file, open_log, self._clock, fetched.open))
            finally:  # recordings that cannot be shown would fill the disk
                file.unlink(missing_ok=True)
            self.replays[title] = feed
        self._follow(feed)
        return self._at_moment(feed, stamp)

    @staticmethod
    def _at_moment(feed: ReplayFeed, stamp: int | None) -> str:
        if stamp is not None:
            feed.show_moment(stamp)
        return feed.name

    def show_emulated(self, viewers: Iterable[Viewer]) -> None:
        """Send the faults and obstacles of the emulated robot, if there is one."""
        if self._emulated is not None:
            frame = frames.text("emulated", **self._emulated.state())
            for viewer in viewers:
                viewer.show("emulated", frame)

    def emulate(self, command: InjectFault | PlaceObstacle) -> None:
        """Change the emulated robot or its world.

        Raises:
            InputError: this station emulates no robot, or the emulator refuses the change.
        """
        if self._emulated is None:
            raise InputError("no robot of this station is emulated")
        match command:
            case InjectFault():
                self._emulated.inject(command.device, command.fault)
            case PlaceObstacle():
                self._emulated.place(command.at)
        self.show_emulated(self._viewers)

    def _found(self, address: RobotAddress) -> None:
        """Follow a robot that appeared, and offer it in every browser."""
        if address.name in self.feeds:
            return
        log.info("robot %s appeared at %s", address.name, address.endpoint)
        self.feeds[address.name] = RobotFeed(address, self._clock)
        self._follow(self.feeds[address.name])

    def application(self) -> web.Application:
        """Return the application with all routes."""
        application = web.Application(middlewares=[self._guard], client_max_size=commands.LONGEST_MESSAGE)
        application.add_routes(
            [
                web.get("/", self._index),
                web.get("/page/{file}", self._file),
                web.get("/strings.json", self._table),
                web.get("/robots/{robot}/map/{version}", self._map),
                web.get("/robots/{robot}/recordings/{name}", self._recording),
                web.get("/socket", self._socket),
            ]
        )
        application.on_shutdown.append(self._hang_up)
        return application

    async def _hang_up(self, _: web.Application) -> None:
        leaving = [_let_go(each, transport, WSCloseCode.GOING_AWAY) for each, (_, transport) in self._sockets.items()]
        await asyncio.gather(*leaving, return_exceptions=True)

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Refuse requests that other sites cause a browser to send."""
        if request.host not in self.place.names:
            raise self._refused(request, f"host {request.host!r} is not a name of this station")
        origin = request.headers.get("Origin")
        foreign = origin is not None and origin not in self.place.origins
        if foreign or (request.path == "/socket" and origin is None):
            raise self._refused(request, f"origin {origin!r} is not a page of this station")
        # Requests from images and links of other sites have no origin.
        if request.path != "/" and request.headers.get("Sec-Fetch-Site", OWN_SITE[0]) not in OWN_SITE:
            raise self._refused(request, "requested by a page of another site")
        if self.place.users is None:
            request[USER] = LOCAL
        else:
            user = await self.place.users.who(request.headers.get("Authorization"), request.remote or "")
            if user is None:
                self._refused(request, "no valid login")
                challenge = {"WWW-Authenticate": 'Basic realm="monstertruckd", charset="UTF-8"'}
                raise web.HTTPUnauthorized(headers=HEADERS | challenge)
            request[USER] = user
        response = await handler(request)
        if not response.prepared:
            response.headers.update(HEADERS)
        return response

    def _refused(self, request: web.Request, why: str) -> web.HTTPForbidden:
        asked = f"{request.method[:20]} {request.raw_path[:100]} from {request.remote}"
        self._remarks.add(request.remote, f"{asked} refused: {why}")
        return web.HTTPForbidden(text=why, headers=HEADERS)

    def _refuse_rubbish(self, record: logging.LogRecord) -> bool:
        """Log filter for aiohttp: shorten its line about a malformed HTTP request; pass all other lines."""
        fault = record.exc_info[1] if isinstance(record.exc_info, tuple) else None
        if not isinstance(fault, HttpProcessingError):
            return True
        peer = str(record.args[0]) if isinstance(record.args, tuple) and record.args else "?"
        self._remarks.add(peer, f"request from {peer} refused: {' '.join(fault.message.split())}")
        return False

    # Files

    async def _index(self, _: web.Request) -> web.StreamResponse:
        return _page_file("index.html")

    async def _file(self, request: web.Request) -> web.StreamResponse:
        name = request.match_info["file"]
        if not FILES.fullmatch(name) or not (PAGE / name).is_file():
            raise web.HTTPNotFound
        return _page_file(name)

    async def _table(self, _: web.Request) -> web.StreamResponse:
        return web.Response(body=self._strings, content_type="application/json")

    async def _map(self, request: web.Request) -> web.StreamResponse:
        name = request.match_info["robot"]
        feed = self.feeds.get(name) or self.replays.get(name)
        cells = None if feed is None else await feed.map.packed()
        if cells is None:
            raise web.HTTPNotFound
        return web.Response(
            body=cells, content_type="application/octet-stream", headers={"Content-Encoding": "deflate"}
        )

    async def _recording(self, request: web.Request) -> web.StreamResponse:
        feed, name, user = self.feeds.get(request.match_info["robot"]), request.match_info["name"], request[USER]
        if not user.may(AccessRole.PILOT):
            raise self._refused(request, f"user {user.name!r} is {user.role.value}: expected pilot")
        if feed is None or not RECORDING.fullmatch(name):
            self._refused(request, "expected the names of a robot and a recording")
            raise web.HTTPNotFound
        text = f"sending recording {name} of {feed.address.name} to {request.remote}"
        self._remarks.add(request.remote, text, logging.INFO)
        users = self.place.users

        def may() -> bool:
            return users is None or users.stands(user)

        return await download(request, feed.address, name, user.name, self._clock, HEADERS, may)

    # One browser

    async def _socket(self, request: web.Request) -> web.StreamResponse:
        user = request[USER]
        count, own = len(self._browsers), sum(each.user.name == user.name for each in self._browsers)
        if count >= MOST_BROWSERS or (user is not LOCAL and own >= MOST_OF_USER):
            self._refused(request, f"{count} browsers are connected, {own} of them by this user: close one first")
            raise web.HTTPServiceUnavailable(text="too many browsers", headers=HEADERS)
        name = f"{user.name}{'-' * bool(user.name)}{self._run}.{next(self._numbers)}"
        browser = _Browser(name, user, self, self._board, self._clock)
        self._browsers.append(browser)
        try:
            return await self._converse(request, browser)
        finally:
            self._browsers.remove(browser)

    async def _converse(self, request: web.Request, browser: "_Browser") -> web.WebSocketResponse:
        name, peer = browser.name, request.remote
        # 10.0: ping interval of the WebSocket itself (s); a browser that does not answer for half of it is
        # disconnected
        socket = web.WebSocketResponse(max_msg_size=commands.LONGEST_MESSAGE, heartbeat=10.0, compress=False)
        await socket.prepare(request)
        self._remarks.add(peer, f"browser {name} connected from {peer}", logging.INFO)
        self._viewers.add(browser.viewer)
        self._sockets[socket] = browser.user, request.transport
        sending = asyncio.create_task(_send(socket, browser.viewer))
        pace = _Pace()
        try:
            async for received in socket:
                if self.place.users is not None and not self.place.users.stands(browser.user):
                    break  # disconnected, or about to be
                if received.type is not WSMsgType.TEXT:
                    self._remarks.add(peer, f"browser {name} at {peer} refused: {_fault(received)}")
                    break
                try:
                    browser.take(received.data)
                except (InputError, NotPermittedError) as error:
                    self._remarks.add(peer, f"browser {name}: message refused: {error}")
                    browser.viewer.send(frames.text("trouble", text=str(error)))
                await pace.keep()
        finally:
            self._viewers.discard(browser.viewer)
            del self._sockets[socket]
            sending.cancel()
            await asyncio.gather(sending, return_exceptions=True)
            await browser.close()
            self._remarks.add(peer, f"browser {name} disconnected", logging.INFO)
        return socket


async def _let_go(socket: web.WebSocketResponse, transport: asyncio.Transport | None, code: int) -> None:
    """Close a browser's WebSocket; abort the connection of a browser that reads nothing and would block the close."""
    try:
        async with asyncio.timeout(END):
            await socket.close(code=code)
    except TimeoutError:
        if transport is not None:
            transport.abort()


class _Pace:
    """Slows down a browser that sends more than ``MESSAGES`` per second."""

    def __init__(self) -> None:
        self._clock = asyncio.get_running_loop().time
        self._left, self._at = MESSAGES, self._clock()

    async def keep(self) -> None:
        """Wait after a message if there have been too many."""
        now = self._clock()
        self._left, self._at = min(self._left + (now - self._at) * MESSAGES, MESSAGES) - 1.0, now
        if self._left < 0.0:
            await asyncio.sleep(-self._left / MESSAGES)


class _Browser:
    """Connection of one browser, with its feed and its commands."""

    def __init__(self, name: str, user: StationUser, station: Station, board: FleetBoard, clock: Clock) -> None:
        self.viewer = Viewer()
        self._board = board
        self.name = name
        self.user = user
        self._station = station
        self._clock = clock
        self._feed: RobotFeed | ReplayFeed | None = None
        self._pilot: Pilot | None = None
        self._session: asyncio.Task[None] | None = None
        self._calibration: Calibration | None = None
        self._ending: set[asyncio.Task[None]] = set()
        self.viewer.send(frames.text("hello", version=__version__, user=user.name, role=user.role.value))
        self.viewer.send(frames.text("robots", names=station.names))
        station.show_emulated((self.viewer,))

    def take(self, data: str) -> None:
        """Execute the command in one message.

        Raises:
            InputError: the message is not a command, or names an unknown robot.
            NotPermittedError: the user may not give this command.
        """
        command = commands.parse(data)
        refused = self._refusal(command)
        if refused is not None:
            raise self._answered(command, refused)
        match command:
            case Heartbeat():
                if self._pilot is not None:
                    self._pilot.drive(command)
            case ControlReplay():
                if isinstance(self._feed, ReplayFeed):
                    self._feed.control(command.at, command.playing, command.rate)
                    if command.stamp is not None:
                        self._feed.show_moment(command.stamp)
            case ReplayRecording():
                self._fetch(command)
            case EchoRequest():
                self.viewer.send(frames.text("pong", at=command.at, now=self._clock.now() / 1e6))
            case LookAtFleet():
                self._board.show(self.viewer, command.on)
            case Watch():
                self._watch(command.robot)
            case InjectFault() | PlaceObstacle() | ListNumbers() | PlotNumbers():
                self._do(command)
            case _:
                self._ask_robot(command)

    def _do(self, command: InjectFault | PlaceObstacle | ListNumbers | PlotNumbers) -> None:
        """Execute a command to the station itself, and answer it."""
        value: dict[str, Any] = {}
        try:
            match command:
                case ListNumbers():
                    value = {"numbers": dict(numbers())}
                case PlotNumbers():
                    require_numbers(command.names)
                    self.viewer.plotted, self.viewer.plot_set = command.names, command.set
                case _:
                    self._station.emulate(command)
        except InputError as error:
            raise self._answered(command, error) from None
        self.viewer.send(frames.text("answer", id=command.id, ok=True, value=value))

    def _ask_robot(self, command: commands.Asked) -> None:
        """Execute a command that needs a robot."""
        if self._pilot is None:
            raise self._answered(command, InputError("no robot is selected"))
        if isinstance(command, Calibrate):
            self._begin(self._calibrate(command))
        else:
            self._pilot.ask(command)

    async def _calibrate(self, command: Calibrate) -> None:
        value: dict[str, Any] = {}
        try:
            if self._calibration is None:
                raise InputError("this station does not calibrate robots")
            match command.order:
                case "list":
                    value = {"wizards": await self._calibration.offer()}
                case "start":
                    self._calibration.begin(command.step, command.options)
                case "answer":
                    self._calibration.answer(command.value)
                case "accept" | "discard":
                    self._calibration.decide(accept=command.order == "accept")
        except TruckError as error:
            self.viewer.send(frames.refusal(command.id, error))
        else:
            self.viewer.send(frames.text("answer", id=command.id, ok=True, value=value))

    def _fetch(self, command: ReplayRecording) -> None:
        if len(self._ending) >= MOST_REPLAYS:
            raise self._answered(command, InputError("recordings are already being fetched"))
        self._begin(self._replay(command))

    def _answered(self, command: commands.AnyCommand | commands.Asked, error: TruckError) -> TruckError:
        """Report the error as the outcome of a command, if the command has one; return the error."""
        if isinstance(command, commands.Asked):
            self.viewer.send(frames.refusal(command.id, error))
        return error

    def _refusal(self, command: commands.AnyCommand) -> NotPermittedError | None:
        """Return why the user may not give this command now."""
        if not self.user.may(needed := commands.needed(command)):
            return NotPermittedError(f"user {self.user.name!r} is {self.user.role.value}: expected {needed.value}")
        if isinstance(self._feed, ReplayFeed) and not _while_replaying(command):
            return NotPermittedError("a recording is shown: only a stop is sent to the robot")
        return None

    def _begin(self, job: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(job)
        self._ending.add(task)
        task.add_done_callback(self._ending.discard)

    async def _replay(self, command: ReplayRecording) -> None:
        feed = self._feed
        try:
            if not isinstance(feed, RobotFeed):
                raise InputError("no robot is selected")
            name = await self._station.replay(feed.address, command.name, self.user.name, self.viewer, command.stamp)
        except TruckError as error:
            self.viewer.send(frames.refusal(command.id, error))
        else:
            self.viewer.send(frames.text("answer", id=command.id, ok=True, value={"robot": name}))

    def _watch(self, robot: str) -> None:
        if (replay := self._station.replays.get(robot)) is not None:
            self._show_replay(replay)
            return
        feed = self._station.feeds.get(robot)
        if feed is None:
            raise InputError(f"robot {robot!r}: expected one of {', '.join(self._station.names)}")
        self._leave()
        self.viewer.send(frames.text("robot", name=robot))
        self._feed = feed
        feed.attach(self.viewer)
        self._take_pilot(feed)

    def _take_pilot(self, feed: RobotFeed) -> None:
        self._pilot = Pilot(feed.address, self.name, self.viewer, self._clock, lambda: feed.client)
        self._session = asyncio.create_task(self._pilot.run())
        self.viewer.send(frames.text("stops", robot=feed.address.name))
        if (calibrator := self._station.calibrator) is not None:
            program = f"{self.user.name}{'.' * bool(self.user.name)}calibrate"
            self._calibration = Calibration(feed.address, program, self._clock, calibrator, self.viewer)

    def _show_replay(self, replay: ReplayFeed) -> None:
        """Show a recording; keep or open the session with the robot, so that its emergency stop remains available."""
        if self._feed is not None:
            self._feed.detach(self.viewer)
        self.viewer.forget()
        self.viewer.send(frames.text("robot", name=replay.name))
        self._feed = replay
        replay.attach(self.viewer)
        if self._pilot is None:
            self._take_pilot(self._station.feeds[replay.robot])

    def _leave(self) -> None:
        if self._feed is not None:
            self._feed.detach(self.viewer)
        self.viewer.forget()
        if self._session is not None:
            self._session.cancel()
            self._ending.add(self._session)
            self._session.add_done_callback(self._ending.discard)
        if self._calibration is not None and (ended := self._calibration.end()) is not None:
            self._ending.add(ended)
            ended.add_done_callback(self._ending.discard)
        self._calibration = None
        self._feed = self._pilot = self._session = None

    async def close(self) -> None:
        """End the browser's sessions."""
        self._board.show(self.viewer, False)
        self._leave()
        for task in self._ending:
            task.cancel()
        await asyncio.gather(*self._ending, return_exceptions=True)


def _peer(connection: web.RequestHandler) -> str:
    """Return the address of the peer, or its network for IPv6."""
    transport = connection.transport
    name = None if transport is None else transport.get_extra_info("peername")
    return network_of(str(name[0])) if name else "?"


def _while_replaying(command: commands.AnyCommand) -> bool:
    """Return whether a command may be executed while a recording is shown."""
    if isinstance(command, commands.GiveOrder):
        return command.order in UNCONDITIONAL
    return isinstance(command, commands.LOOKING)


async def _send(socket: web.WebSocketResponse, viewer: Viewer) -> None:
    with suppress(ConnectionError):
        while True:
            frame = await viewer.next()
            if isinstance(frame, bytes):
                await socket.send_bytes(frame)
            else:
                await socket.send_str(frame)


def _fault(received: WSMessage) -> str:
    """Return why a message other than text ends the connection."""
    if received.type is WSMsgType.ERROR:
        return str(received.data)
    return f"a message of type {received.type.name.lower()}, expected text"


def _page_file(name: str) -> web.Response:
    file = PAGE / name
    return web.Response(body=file.read_bytes(), content_type=TYPES[file.suffix], charset="utf-8")


def _strings(language: str = LANGUAGE) -> bytes:
    """Return all texts of the page by key; a reason has the robot's text unless the table has a better one."""
    table = {f"reason.{reason.value}": reason.text for reason in Reason}
    table |= json.loads((PAGE / "strings" / f"{language}.json").read_text(encoding="utf-8"))
    return json.dumps(table).encode()
