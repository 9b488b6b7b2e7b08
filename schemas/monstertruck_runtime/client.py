"""Client of one robot for stations and scripts: typed messages and remote calls over Zenoh."""

import asyncio
import ctypes
import json
import logging
import secrets
import threading
from collections.abc import Callable, Coroutine, Sequence
from functools import partial
from typing import Any, Final, Generic, Self, TypeVar

import zenoh
from zenoh import ext, handlers

from monstertruck_runtime import wire
from monstertruck_runtime.clock import SECOND, Clock, WallClock
from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT, protocol_of
from monstertruck_runtime.errors import (
    InputError,
    NoAnswerError,
    NotFoundError,
    NotPermittedError,
    RequestRefusedError,
    TruckError,
)
from monstertruck_runtime.mailbox import Delivery, Mailbox, latest
from monstertruck_runtime.requests import Operator
from monstertruck_runtime.robots import only_robot
from monstertruck_runtime.stations import ClientTls, own_source, require_certificates, session_config, tls_for
from monstertruck_runtime.threads import ThreadHop, in_daemon_thread, in_thread
from monstertruck_schemas.base import Message, Pose2D
from monstertruck_schemas.mission import Mission
from monstertruck_schemas.plan import Path as DrivePath
from monstertruck_schemas.points import PointOrder
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import (
    UNCONDITIONAL,
    ControlRequest,
    DriveRequest,
    ExploreOrder,
    GoalOrder,
    LocalisationRequest,
    MapRequest,
    MissionOrder,
    Order,
    PathRequest,
    RequestedTwist,
    Role,
)
from monstertruck_schemas.sensor import StandPose
from monstertruck_schemas.state import GateState
from monstertruck_schemas.topics import (
    GATE,
    REQ_CONTROL,
    REQ_DRIVE,
    REQ_LOCALISATION,
    REQ_MAP,
    REQ_PATH,
    SOURCE_NAME,
    STAND_POSE,
    Topic,
    Writer,
    alive_key,
    estop_key,
    rpc_key,
)
from monstertruck_schemas.zones import OFF_FOR, ZoneArea, ZoneOrder

log = logging.getLogger(__name__)

M = TypeVar("M", bound=Message)


ORDER_TIMEOUT: Final = 6.0
"""Timeout for the outcome of an order (s): the robot itself gives up after 5 s."""


def in_network_thread(take: Callable[[zenoh.Sample], object]) -> "handlers.Callback[zenoh.Sample]":
    """Handler that calls ``take`` in the thread that reads the network.

    Zenoh-python's default uses an additional thread.

    During the call no other data is read from that link, so ``take`` must be fast and must not use the session. The
    thread's interpreter state is kept: creating it for every message costs more than switching threads.
    """
    kept = threading.local()

    def receive(sample: zenoh.Sample) -> None:
        if not hasattr(kept, "state"):
            kept.state = ctypes.pythonapi.PyGILState_Ensure()  # never released
        take(sample)

    return handlers.Callback(receive, indirect=False)


def _arguments_for(robot: str, endpoint: str) -> str:
    return f"{robot!r}, {endpoint!r}"


class Watched(Generic[M]):
    """Latest message of a topic; a context manager that ends the subscription.

    Args:
        topic: row of the topic table.
        declare: subscribes with a handler for samples.
    """

    def __init__(self, topic: Topic[M], declare: Callable[..., Any]) -> None:
        self._topic = topic
        self._bytes: bytes | None = None
        self._decoded: tuple[bytes | None, M | None] = None, None
        self._subscriber = declare(in_network_thread(self._take))

    def _take(self, sample: zenoh.Sample) -> None:
        self._bytes = sample.payload.to_bytes()

    @property
    def latest(self) -> M | None:
        """Latest message; None before the first one, or if it cannot be decoded."""
        data = self._bytes
        if data is not self._decoded[0] and data is not None:
            try:
                self._decoded = data, wire.decode(self._topic, data)
            except InputError as error:
                log.warning("message skipped: %s", error)
                self._decoded = data, None
        return self._decoded[1]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._subscriber.undeclare()


class TruckClient(Operator):
    """Session with one robot; an async context manager.

    It never listens: it connects to one endpoint, and reconnects when the robot restarts. Messages that cannot be
    decoded are logged and skipped.

    Args:
        robot: name in the keys ``mt/<robot>/...``; None: ``truck``.
        endpoint: address of the robot, e.g. ``tcp/192.168.1.7:7447``; None: port 7447 of this computer, if it is
            unambiguous.
        source: this program's name in requests; default ``user@host:pid``. With a certificate it is the common name, by
            default followed by a colon and a suffix: Zenoh drops requests under other names.
        role: role of its requests; decides their priority.
        clock: clock for stamps and deadlines; robots do not trust it.
        timeout: timeout for the link and for answers, s.
        tls: certificate files for ``tls/...`` endpoints; None for the files of ``station_tls``.

    Raises:
        InputError: the source contains characters not allowed in a key.
    """

    def __init__(
        self,
        robot: str | None = None,
        endpoint: str | None = None,
        *,
        source: str | None = None,
        role: Role = Role.STATION,
        clock: Clock | None = None,
        timeout: float = 2.5,
        tls: ClientTls | None = None,
    ) -> None:
        self.robot = robot or "truck"
        self.endpoint = endpoint or DEFAULT_ENDPOINT
        self._choose = None if endpoint is not None else partial(only_robot, robot, _arguments_for)
        self._named = source is not None
        self.source = source or own_source()
        if not SOURCE_NAME.fullmatch(self.source):
            raise InputError(f"source {self.source!r}: expected letters, digits and . _ : - @, not starting with @")
        self.role = role
        self._clock = clock or WallClock()
        self._timeout = timeout
        self._tls = tls
        self._session: zenoh.Session | None = None
        self._subscriptions: dict[Mailbox[Any], Callable[[], None]] = {}
        self._gate: Mailbox[GateState] | None = None
        self._asking = asyncio.Lock()
        # Must also increase from one run of this program to the next.
        self._seq = (self._clock.now() + self._clock.real_offset()) // 1000
        self._instance = secrets.token_hex(8)
        self._overtaking = 0
        """Number of stops and emergency stops ordered so far."""

    async def __aenter__(self) -> Self:
        """Connect to the endpoint.

        Raises:
            InputError: no endpoint is given and several robots run on this computer; the message lists them.
            NotFoundError: no robot answers at the endpoint, or a file of the certificate is missing.
            NotPermittedError: other users may read the certificate's key, the source differs from the certificate's
                name, or a certificate is rejected.
        """
        try:
            await in_thread(self._open)
        except asyncio.CancelledError:
            await self._close()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        """End all subscriptions and the session."""
        for mailbox in list(self._subscriptions):
            mailbox.close()
        await self._close()

    # Subscriptions

    def subscribe(self, topic: Topic[M], delivery: Delivery) -> Mailbox[M]:
        """Subscribe to ``topic``; a retained topic delivers its latest message at once.

        Args:
            topic: row of the topic table.
            delivery: ``latest()`` or ``fifo(n)``.
        """
        mailbox: Mailbox[M] = Mailbox(delivery, self._unsubscribe)
        hop: ThreadHop[bytes] = ThreadHop(partial(_deliver, topic, mailbox), max(1024, delivery.depth), mailbox.lose)

        def receive(sample: zenoh.Sample) -> None:
            hop.put(sample.payload.to_bytes())

        subscriber = self._declare(topic, receive)

        def end() -> None:
            hop.close()
            subscriber.undeclare()

        self._subscriptions[mailbox] = end
        return mailbox

    def tap(self, topic: Topic[Any], take: Callable[[bytes], object]) -> Any:
        """Pass the bytes of every message of ``topic`` to ``take``, in a thread that reads the network.

        A retained topic delivers its latest message at once. ``undeclare()`` of the returned object ends it.
        """
        return self._declare(topic, lambda sample: take(sample.payload.to_bytes()))

    def _declare(self, topic: Topic[Any], receive: Callable[[zenoh.Sample], object]) -> Any:
        key = topic.key(self.robot)
        if not topic.retained:
            return self._open_session().declare_subscriber(key, in_network_thread(receive))
        history = ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
        return ext.declare_advanced_subscriber(self._open_session(), key, receive, history=history)

    def watch(self, topic: Topic[M]) -> "Watched[M]":
        """Follow the latest message of ``topic``, decoded only on request.

        For reading a topic less often than it is published: skipped messages cost almost nothing.
        """
        return Watched(topic, partial(self._open_session().declare_subscriber, topic.key(self.robot)))

    async def get_retained(self, topic: Topic[M]) -> M | None:
        """Return the latest message of a retained topic; None if the robot has not published one yet.

        Raises:
            NoAnswerError: no answer in time.
            NotFoundError: no such robot.
        """
        for reply in await self._get(topic.key(self.robot)):
            return wire.decode(topic, _payload(reply))
        if await self.alive():
            return None
        raise await self._absent()

    async def alive(self) -> bool:
        """Whether the robot's daemon is running."""
        return bool(await self._seen(self.robot, self._timeout))

    async def _seen(self, name: str, timeout: float) -> list[str]:
        """Names of the running robots: one name, or all with ``*``."""
        replies = await self._collect(
            lambda handler: self._open_session().liveliness().get(alive_key(name), handler, timeout=timeout)
        )
        return [str(reply.ok.key_expr).split("/")[1] for reply in replies if reply.ok is not None]

    # Remote calls

    async def call(
        self, rpc: str, payload: dict[str, Any] | None = None, timeout: float | None = None
    ) -> dict[str, Any]:
        """Call ``rpc`` on the robot with a JSON object; return its answer.

        Args:
            rpc: name of the call.
            payload: JSON object.
            timeout: timeout, s; None: the client's timeout.

        Raises:
            NotFoundError: no such robot or call.
            InputError: the robot rejected the payload.
            NoAnswerError: no answer in time, although the robot may be running.
            RequestRefusedError: the robot refused; carries the reason.
        """
        answer: dict[str, Any] = json.loads(await self._call(rpc, payload or {}, timeout))
        return answer

    async def _call(self, rpc: str, payload: dict[str, Any], timeout: float | None) -> bytes:
        replies = await self._get(rpc_key(self.robot, rpc, self.source), json.dumps(payload), timeout)
        if not replies:
            raise await self._absent()
        return _payload(replies[0])

    # Requests

    async def drive(
        self, speed: float, front: float, rear: float = 0.0, lease: float = 0.3, *, unseen: bool = False
    ) -> None:
        """Request a speed (m/s) and axle angles (rad, left positive) for ``lease`` seconds.

        Sent by topic, for speed; ``state/gate`` (holder, last_seq) and events show whether it is granted. ``unseen``
        confirms that an operator drives slowly into ground that no sensor has seen.

        Raises:
            NoAnswerError: the robot's nonce was not received in time.
        """
        header = await self.header(lease)
        self._put(REQ_DRIVE, DriveRequest(**header, speed=speed, front=front, rear=rear, unseen=unseen))

    async def drive_twist(
        self, vx: float, vy: float = 0.0, wz: float = 0.0, lease: float = 0.3, *, unseen: bool = False
    ) -> None:
        """Request a velocity of the base (forward and left in m/s, yaw rate in rad/s) for ``lease`` seconds.

        The robot refuses a motion that its body cannot make, with an event ``impossible_motion``. ``unseen`` and errors
        as in ``drive``.
        """
        header = await self.header(lease)
        twist = RequestedTwist(vx=vx, vy=vy, wz=wz)
        self._put(REQ_DRIVE, DriveRequest(**header, speed=0.0, front=0.0, twist=twist, unseen=unseen))

    async def drive_shafts(self, *rates: float, lease: float = 0.3) -> None:
        """Request the wheel rate of every driven shaft, rad/s, for ``lease`` seconds: open loop, for engineers.

        Limits, ramps and the sweep apply as for every request. Raises the errors of ``drive``.
        """
        self._put(REQ_DRIVE, DriveRequest(**await self.header(lease), speed=0.0, front=0.0, shafts=rates))

    def publish_stand_pose(self, pose: StandPose) -> None:
        """Publish the robot's true pose measured by a test stand: the robot records it and does not use it."""
        self._open_session().put(
            STAND_POSE.key(self.robot), wire.encode(STAND_POSE, pose), encoding=wire.encoding(STAND_POSE)
        )

    def order(self, order: Order, *, hold: bool = False, calibrates: bool = False) -> Coroutine[Any, Any, GateState]:
        """Send an order and wait until it is carried out; return the resulting gate state.

        An emergency stop or stop is published by this call immediately, even without a connection to the robot or if
        its outcome is not awaited. Any other order that is then still waiting for the robot's nonce is withdrawn.

        Args:
            order: order to send.
            hold: with an order to arm: planners do not drive until the truck is armed without it.
            calibrates: with an order to arm: see ``ControlRequest``.

        Raises:
            RequestRefusedError: refused, or superseded by a stop; carries the reason.
            NoAnswerError: no answer in time, or the robot's nonce was not received in time.
            NotFoundError: no such robot.
        """
        if order in UNCONDITIONAL:
            self._overtaking += 1
            request = ControlRequest(**self._header(1.0), order=order)
            self._put(REQ_CONTROL, request, estop_key if order is Order.ESTOP else REQ_CONTROL.key)
        flags = {"hold": hold, "calibrates": calibrates}
        return self._outcome(order, self._overtaking, {name: True for name, wanted in flags.items() if wanted})

    async def ask_to_drive(self) -> GateState:
        """Request control from the driving operator; the gate's state lists it in ``asking``.

        Raises the errors of ``order``.
        """
        return await self._outcome(Order.ASK, self._overtaking, {})

    async def hand_over(self, to: str) -> GateState:
        """Hand over to an operator who has requested control; only the driving operator can.

        Raises the errors of ``order``.
        """
        return await self._outcome(Order.HAND_OVER, self._overtaking, {"to": to})

    async def _outcome(self, order: Order, overtaking: int, more: dict[str, Any]) -> GateState:
        header = self._header(1.0) if order in UNCONDITIONAL else await self.header()
        if overtaking != self._overtaking and order not in UNCONDITIONAL:
            raise RequestRefusedError(Reason.BAD_SEQUENCE, f"{order.value}: superseded by a stop")
        return wire.decode(GATE, await self._call(order.value, header | more, ORDER_TIMEOUT))

    async def goal(
        self, goal: tuple[float, float, float], frame: str = "map", via: Sequence[tuple[float, ...]] = ()
    ) -> dict[str, Any]:
        """Request to drive to x, y (m), yaw (rad), and wait for the first route; return the goal's ``number``.

        ``via`` are waypoints: x, y and optionally yaw. ``plan/goal`` publishes the progress. Numbers that are not
        finite are sent to the robot, which refuses them by name.

        Raises:
            RequestRefusedError: no route to the goal, or the robot does not drive; carries the reason.
            NotFoundError: no such robot, or it has no planner.
            NoAnswerError: no answer in time.
        """
        x, y, yaw = goal
        return await self.call(
            "goal",
            {
                **await self.header(),
                "frame": frame,
                "goal": {"x": x, "y": y, "yaw": yaw},
                "waypoints": [dict(zip(("x", "y", "yaw"), place, strict=False)) for place in via],
            },
        )

    async def goal_control(self, order: GoalOrder, *, own: bool = False) -> None:
        """Pause, resume or cancel the goal; ``own``: only a goal of this client. Raises the errors of ``goal``."""
        await self.call("goal_control", {**await self.header(), "order": order, "own": own})

    async def explore(
        self,
        order: ExploreOrder,
        *,
        home: bool | None = None,
        budget: float | None = None,
        find: int | None = None,
        own: bool = False,
    ) -> dict[str, Any]:
        """Start or end an exploration; return its ``number``. ``plan/explore`` publishes the progress.

        Args:
            order: start or stop.
            home: drive back to the start at the end; None: as configured.
            budget: time limit, s; None: as configured.
            find: also search for tags on walls, and end when this many are known.
            own: with a stop: only an exploration started by this client.

        Raises:
            RequestRefusedError: it does not start, or none is running; carries the reason.
            NotFoundError: no such robot, or it does not explore.
            NoAnswerError: no answer in time.
        """
        request = {"order": order, "home": home, "budget": budget, "own": own}
        request |= {} if find is None else {"find": find}
        return await self.call("explore", {**await self.header(), **request})

    async def point(
        self,
        order: PointOrder,
        name: str,
        place: tuple[float, float] | None = None,
        yaw: float | None = None,
    ) -> dict[str, Any]:
        """Mark a place by name, or remove a point of interest; ``state/points`` lists all.

        Args:
            order: mark or remove.
            name: name of the point.
            place: position of a mark in map, m; None: the robot's.
            yaw: yaw of a mark, rad; None: the robot's.

        Returns:
            Pose of a mark: ``x``, ``y`` (m) and ``yaw`` (rad) in map.

        Raises:
            RequestRefusedError: refused; carries the reason.
            NotFoundError: no such robot or point, or the robot keeps no points.
            NoAnswerError: no answer in time.
        """
        x, y = (None, None) if place is None else place
        return await self.call(
            "points", {**await self.header(), "order": order, "name": name, "x": x, "y": y, "yaw": yaw}
        )

    async def zone(
        self, order: ZoneOrder, name: str, area: ZoneArea | None = None, seconds: float = OFF_FOR
    ) -> dict[str, Any]:
        """Add or remove a zone, or turn it on, or off for a while; ``state/zones`` lists all.

        Args:
            order: what to do with the zone.
            name: name of the zone.
            area: polygon of a new zone.
            seconds: duration for which it is off, s.

        Raises:
            RequestRefusedError: refused; carries the reason.
            NotFoundError: no such robot or zone, or the robot keeps no zones.
            InputError: the zone is defined in the configuration.
            NoAnswerError: no answer in time.
        """
        polygon = None if area is None else area.model_dump(mode="json")
        return await self.call(
            "zones", {**await self.header(), "order": order, "name": name, "area": polygon, "seconds": seconds}
        )

    async def mission(
        self, order: MissionOrder, mission: Mission | None = None, *, moved: bool = False, own: bool = False
    ) -> dict[str, Any]:
        """Start, resume or end a mission; return its ``number``. ``plan/mission`` publishes the progress.

        Args:
            order: start, resume or stop.
            mission: mission to start.
            moved: resume it even if the robot is not where it was interrupted.
            own: with a stop: only a mission started or resumed by this client.

        Raises:
            RequestRefusedError: it does not start, or none is running; carries the reason.
            NotFoundError: no such robot, or it does not support missions.
            NoAnswerError: no answer in time.
        """
        steps = None if mission is None else mission.model_dump(mode="json")
        wanted = {"order": order, "mission": steps, "moved": moved, "own": own}
        return await self.call("mission", {**await self.header(), **wanted})

    async def start_path(self, name: str) -> str:
        """Let the armed robot drive the configured path once; return the name under which the tracker follows it.

        Raises:
            RequestRefusedError: it does not start; carries the reason.
            NotFoundError: no such robot or path.
            NoAnswerError: no answer in time.
        """
        return str((await self.call("start_path", {**await self.header(), "path": name}))["path"])

    async def path(self, path: DrivePath, lease: float = 1.0) -> None:
        """Request to follow a path computed by this client. Raises the errors of ``drive``."""
        self._put(REQ_PATH, PathRequest(**await self.header(lease), frame=path.frame, path=path))

    async def localise(self, map_from_odom: tuple[float, float, float], lease: float = 1.0) -> None:
        """Send the pose of odom in map (m, m, rad) to a robot with ``slam.mode: ros2``.

        It is valid for ``lease`` seconds.

        Raises the errors of ``drive``.
        """
        x, y, yaw = map_from_odom
        correction = Pose2D(x=x, y=y, yaw=yaw)
        self._put(REQ_LOCALISATION, LocalisationRequest(**await self.header(lease), correction=correction))

    async def send_map(self, packed: bytes, size: tuple[int, int], resolution: float, origin: Pose2D) -> None:
        """Send a map to a robot with ``slam.mode: ros2``. Raises the errors of ``drive``.

        Args:
            packed: compressed cells, see ``MapRequest.packed``.
            size: width and height in cells.
            resolution: m.
            origin: pose of the corner of the first cell in map.
        """
        width, height = size
        request = MapRequest(
            **await self.header(), resolution=resolution, width=width, height=height, origin=origin, packed=packed
        )
        self._put(REQ_MAP, request)

    def _put(self, topic: Topic[M], message: M, key: Callable[[str, str], str] | None = None) -> None:
        assert topic.writer is Writer.OUTSIDE
        # Requests precede all other data on the link, and an order is never dropped for lack of space.
        driving = topic.name == REQ_DRIVE.name
        self._open_session().put(
            (key or topic.key)(self.robot, self.source),
            wire.encode(topic, message),
            encoding=wire.encoding(topic),
            congestion_control=zenoh.CongestionControl.DROP if driving else zenoh.CongestionControl.BLOCK,
            priority=zenoh.Priority.INTERACTIVE_HIGH if driving else zenoh.Priority.REAL_TIME,
            express=True,
        )

    async def ready(self) -> None:
        """Wait until the robot's nonce is known: until then a request would only wait and age.

        Raises:
            NoAnswerError: it was not received in time.
        """
        async with self._asking:  # only one task at a time waits for it
            gate = self._followed_gate()
            if gate.latest is None:
                try:
                    async with self._clock.deadline(self._timeout):
                        await gate.next()
                except TimeoutError:
                    msg = f"robot {self.robot!r} does not publish its gate state at {self.endpoint}"
                    raise NoAnswerError(msg) from None

    async def header(self, lease: float = 1.0) -> dict[str, Any]:
        """Header of a request, once the robot's nonce is known; raises the errors of ``ready``."""
        await self.ready()
        return self._header(lease)

    def _followed_gate(self) -> Mailbox[GateState]:
        if self._gate is None:
            self._gate = self.subscribe(GATE, latest())
        return self._gate

    def _header(self, lease: float) -> dict[str, Any]:
        state = self._followed_gate().latest
        if state is not None and state.holder == self.source and state.last_seq is not None:
            self._seq = max(self._seq, state.last_seq)
        self._seq += 1
        now = self._clock.now()
        return {
            "stamp": now,
            "received": now,
            "seq": self._seq,
            "source": self.source,
            "role": self.role,
            "lease": lease,
            "nonce": "" if state is None else state.nonce,
            "gate_stamp": None if state is None else state.stamp,
            "instance": self._instance,
        }

    # Zenoh

    async def _close(self) -> None:
        session, self._session = self._session, None
        if session is not None:
            await in_daemon_thread(
                session.close
            )  # also at the end of the program, when thread pools accept no more work

    def _open(self) -> None:
        if self._choose is not None:
            self.endpoint = self._choose()
        tls = self._tls or tls_for(self.endpoint)
        if tls is not None:
            self._take_name(tls.owner())
        config = session_config(self.endpoint, self._timeout, tls)
        began = self._clock.now()
        try:
            self._session = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
        except zenoh.ZError as error:
            require_certificates(self.endpoint, tls)
            waited = (self._clock.now() - began) / SECOND  # longer than ``timeout`` if the computer is busy
            msg = f"no robot answers at {self.endpoint} within {waited:.1f} s: is its daemon running there "
            msg += "(`monstertruckd run`, or `simulate --run`), or is it elsewhere (--endpoint)?"
            raise NotFoundError(msg) from error

    def _take_name(self, owner: str) -> None:
        if not self._named:
            self.source = own_source(owner)
        elif self.source.partition(":")[0] != owner:
            raise NotPermittedError(
                f"source {self.source!r}: the certificate is for {owner!r}; expected this name, or one "
                f"starting with {owner}:"
            )

    def _open_session(self) -> zenoh.Session:
        if self._session is None:
            raise RuntimeError("use the client inside its 'async with'")
        return self._session

    def _unsubscribe(self, mailbox: Mailbox[Any]) -> None:
        self._subscriptions.pop(mailbox)()

    async def _get(self, key: str, payload: str | None = None, timeout: float | None = None) -> list[zenoh.Reply]:
        return await self._collect(
            lambda handler: self._open_session().get(
                key,
                handler,
                payload=payload,
                encoding=None if payload is None else "application/json",
                timeout=timeout or self._timeout,
            )
        )

    async def _collect(self, ask: Callable[["handlers.Callback[zenoh.Reply]"], object]) -> list[zenoh.Reply]:
        """Collect all replies of a query without blocking the loop."""
        loop = asyncio.get_running_loop()
        done: asyncio.Future[None] = loop.create_future()
        replies: list[zenoh.Reply] = []

        def finish() -> None:
            if not done.done():
                done.set_result(None)

        def ended() -> None:
            if not loop.is_closed():
                loop.call_soon_threadsafe(finish)

        ask(handlers.Callback(replies.append, ended))
        await done
        return replies

    async def _absent(self) -> NotFoundError | NoAnswerError:
        """Error for a robot that does not answer: whether it is running, or which other robots are."""
        look = 0.5  # seconds within which running robots answer
        # A robot that requires certificates shows itself only to queries for its name.
        seen = await asyncio.gather(self._seen("*", look), self._seen(self.robot, look))
        names = sorted({name for some in seen for name in some})
        if self.robot in names:
            why = f"it is starting or ending, or does not accept requests of {self.source!r}"
            return NoAnswerError(f"robot {self.robot!r} at {self.endpoint} does not answer: {why}")
        there = f"; found: {', '.join(names)} (--robot NAME)" if names else ""
        if protocol_of(self.endpoint) == "tls":
            there += f", or it does not know the certificate of {self.source.partition(':')[0]!r} (its `zenoh.tls`)"
        return NotFoundError(f"no robot {self.robot!r} at {self.endpoint}{there}")


def _deliver(topic: Topic[M], mailbox: Mailbox[M], data: bytes) -> None:
    try:
        message = wire.decode(topic, data)
    except InputError as error:
        log.warning("message skipped: %s", error)
    else:
        mailbox.put(message)


def _payload(reply: zenoh.Reply) -> bytes:
    """Bytes of a successful reply.

    Raises:
        TruckError: the reply is a refusal.
    """
    if reply.ok is not None:
        return reply.ok.payload.to_bytes()
    assert reply.err is not None
    raise _refusal(reply.err.payload.to_bytes())


def _refusal(data: bytes) -> TruckError:
    """Error of an error reply; Zenoh's own replies are plain text."""
    try:
        fields = json.loads(data)
        reason, text = Reason(fields["reason"]), str(fields["text"])  # type: ignore[call-arg]  # look-up by value
    except (ValueError, KeyError, TypeError):
        text = data.decode(errors="backslashreplace")
        return NoAnswerError("no answer in time") if text == "Timeout" else RequestRefusedError(Reason.INTERNAL, text)
    kinds: dict[Reason, type[TruckError]] = {
        Reason.NOT_FOUND: NotFoundError,
        Reason.BAD_INPUT: InputError,
        Reason.TIMEOUT: NoAnswerError,
    }
    kind = kinds.get(reason)
    return RequestRefusedError(reason, text) if kind is None else kind(text)
