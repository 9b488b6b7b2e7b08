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
"""Seconds to wait for the outcome of an order: the robot itself gives up after 5 s."""


def in_network_thread(take: Callable[[zenoh.Sample], object]) -> "handlers.Callback[zenoh.Sample]":
    """Handler that calls ``take`` in the thread that reads the network; zenoh-python's own way is one thread further.

    While it runs nothing else is read from that link: it must be quick, and must not use the session. The interpreter's
    state of that thread is kept; made again for every message, it costs more than the way to another thread.
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
        declare: subscribes with a handler of samples.
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
        """Latest message; None before the first, and if it cannot be decoded."""
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

    It never listens: it connects to one endpoint, and reconnects when the robot restarts.
    Messages that cannot be decoded are logged and skipped.

    Args:
        robot: name in the keys ``mt/<robot>/...``; None = ``truck``.
        endpoint: where the robot listens, e.g. ``tcp/192.168.1.7:7447``; None = port 7447 of this computer, where only
            one robot of this computer could be meant.
        source: this program's name in requests; default ``user@host:pid``. With a certificate it is the common name,
            or that with a colon and anything behind it, which is the default: requests under other names never arrive.
        role: role of its requests; decides their priority.
        clock: time of stamps and deadlines; robots do not trust it.
        timeout: seconds to wait for the link and for answers.
        tls: certificate files for ``tls/...`` endpoints; None for the files of ``station_tls``.

    Raises:
        InputError: the source cannot be part of a key.
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
            raise InputError(f"source {self.source!r}: expected letters, digits and . _ : - @, but no @ first")
        self.role = role
        self._clock = clock or WallClock()
        self._timeout = timeout
        self._tls = tls
        self._session: zenoh.Session | None = None
        self._subscriptions: dict[Mailbox[Any], Callable[[], None]] = {}
        self._gate: Mailbox[GateState] | None = None
        self._asking = asyncio.Lock()
        # Must also grow from one run of this program to the next.
        self._seq = (self._clock.now() + self._clock.real_offset()) // 1000
        self._instance = secrets.token_hex(8)
        self._overtaking = 0
        """Stops and emergency stops ordered so far."""

    async def __aenter__(self) -> Self:
        """Connect to the endpoint.

        Raises:
            InputError: no endpoint is given, and several robots run on this computer; lists them.
            NotFoundError: nothing answers there, or a file of the certificate is missing.
            NotPermittedError: others may read the certificate's key, the source differs from the certificate's name, or
                a certificate is refused.
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
        """Hand the bytes of every message of ``topic`` to ``take``, in a thread that reads the network.

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
        """Follow the latest message of ``topic``, which is decoded only when it is requested.

        For looking at a topic less often than it is published: messages in between cost next to nothing.
        """
        return Watched(topic, partial(self._open_session().declare_subscriber, topic.key(self.robot)))

    async def get_retained(self, topic: Topic[M]) -> M | None:
        """Latest message of a retained topic; None if the robot has published none yet.

        Raises:
            NoAnswerError: no answer in time.
            NotFoundError: the robot is not there.
        """
        for reply in await self._get(topic.key(self.robot)):
            return wire.decode(topic, _payload(reply))
        if await self.alive():
            return None
        raise await self._absent()

    async def alive(self) -> bool:
        """Whether the robot's daemon serves at this moment."""
        return bool(await self._seen(self.robot, self._timeout))

    async def _seen(self, name: str, timeout: float) -> list[str]:
        """Names of the robots that serve at this moment; of one, or of all by ``*``."""
        replies = await self._collect(
            lambda handler: self._open_session().liveliness().get(alive_key(name), handler, timeout=timeout)
        )
        return [str(reply.ok.key_expr).split("/")[1] for reply in replies if reply.ok is not None]

    # Remote calls

    async def call(
        self, rpc: str, payload: dict[str, Any] | None = None, timeout: float | None = None
    ) -> dict[str, Any]:
        """Call ``rpc`` on the robot with a JSON object; returns its answer.

        Args:
            rpc: name.
            payload: JSON object.
            timeout: seconds to wait; None for the client's timeout.

        Raises:
            NotFoundError: no such robot or rpc.
            InputError: the payload was refused.
            NoAnswerError: no answer in time, or none although the robot is there.
            RequestRefusedError: refused; carries the reason.
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

        It goes by topic, for speed; whether it is granted shows in ``state/gate`` (holder, last_seq) and in events.
        ``unseen`` confirms that an operator drives into ground that no sensor has seen, slowly.

        Raises:
            NoAnswerError: the robot's nonce did not come in time.
        """
        header = await self.header(lease)
        self._put(REQ_DRIVE, DriveRequest(**header, speed=speed, front=front, rear=rear, unseen=unseen))

    async def drive_twist(
        self, vx: float, vy: float = 0.0, wz: float = 0.0, lease: float = 0.3, *, unseen: bool = False
    ) -> None:
        """Request a velocity of the base, forward, to the left (m/s) and turning (rad/s), for ``lease`` seconds.

        The robot refuses a motion that its body cannot execute, with an event ``impossible_motion``. ``unseen`` as in
        ``drive``, which raises the same.
        """
        header = await self.header(lease)
        twist = RequestedTwist(vx=vx, vy=vy, wz=wz)
        self._put(REQ_DRIVE, DriveRequest(**header, speed=0.0, front=0.0, twist=twist, unseen=unseen))

    async def drive_shafts(self, *rates: float, lease: float = 0.3) -> None:
        """Request the rate of the wheels on every driven shaft, rad/s, for ``lease`` seconds: open loop, for engineers.

        Limits, ramps and the sweep hold as for every request. Raises as ``drive`` does.
        """
        self._put(REQ_DRIVE, DriveRequest(**await self.header(lease), speed=0.0, front=0.0, shafts=rates))

    def publish_stand_pose(self, pose: StandPose) -> None:
        """Say where the robot really is, as a test stand sees it: the robot records it, and nothing in it reads it."""
        self._open_session().put(
            STAND_POSE.key(self.robot), wire.encode(STAND_POSE, pose), encoding=wire.encoding(STAND_POSE)
        )

    def order(self, order: Order, *, hold: bool = False, calibrates: bool = False) -> Coroutine[Any, Any, GateState]:
        """Give an order; the coroutine waits until it is carried out and returns the gate's state then.

        An emergency stop or stop is published by this call itself, whatever is known of the robot and whether or not
        its outcome is awaited. Any other order that is still waiting for the robot's nonce then is withdrawn.

        Args:
            order: what.
            hold: of an order to arm: planners do not drive until the truck is armed without it.
            calibrates: of an order to arm: see ``ControlRequest``.

        Raises:
            RequestRefusedError: refused, or overtaken by a stop; carries the reason.
            NoAnswerError: no answer in time, or the robot's nonce did not come in time.
            NotFoundError: the robot is not there.
        """
        if order in UNCONDITIONAL:
            self._overtaking += 1
            request = ControlRequest(**self._header(1.0), order=order)
            self._put(REQ_CONTROL, request, estop_key if order is Order.ESTOP else REQ_CONTROL.key)
        flags = {"hold": hold, "calibrates": calibrates}
        return self._outcome(order, self._overtaking, {name: True for name, wanted in flags.items() if wanted})

    async def ask_to_drive(self) -> GateState:
        """Ask the operator who drives to hand over: it shows in ``asking`` of the gate's state. Raises as ``order``."""
        return await self._outcome(Order.ASK, self._overtaking, {})

    async def hand_over(self, to: str) -> GateState:
        """Let another operator drive, who has requested it; only who drives can. Raises as ``order`` does."""
        return await self._outcome(Order.HAND_OVER, self._overtaking, {"to": to})

    async def _outcome(self, order: Order, overtaking: int, more: dict[str, Any]) -> GateState:
        header = self._header(1.0) if order in UNCONDITIONAL else await self.header()
        if overtaking != self._overtaking and order not in UNCONDITIONAL:
            raise RequestRefusedError(Reason.BAD_SEQUENCE, f"{order.value}: overtaken by a stop")
        return wire.decode(GATE, await self._call(order.value, header | more, ORDER_TIMEOUT))

    async def goal(
        self, goal: tuple[float, float, float], frame: str = "map", via: Sequence[tuple[float, ...]] = ()
    ) -> dict[str, Any]:
        """Request to drive to x, y (m), yaw (rad), and wait for the first route; returns the goal's ``number``.

        ``via`` are waypoints, x, y and optionally yaw. Progress is published on ``plan/goal``. Numbers that are not
        finite reach the robot, which refuses them by name.

        Raises:
            RequestRefusedError: no route to the goal, or why the robot does not drive.
            NotFoundError: the robot is not there, or has no planner.
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
        """Pause, resume or cancel the goal; ``own``: only one that this client sent. Raises as ``goal`` does."""
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
        """Start an exploration, or end it; answers with its ``number``. Progress is on ``plan/explore``.

        Args:
            order: which of both.
            home: drive back to the start at the end; None for the configured value.
            budget: time limit, s; None for the configured value.
            find: look for tags on walls, too, and end when so many are known.
            own: with a stop: only one that this client started.

        Raises:
            RequestRefusedError: why it does not start, or none runs.
            NotFoundError: the robot is not there, or does not explore.
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
        """Mark a place by name, or have a point of interest forgotten; all are on ``state/points``.

        Args:
            order: which of both.
            name: name of the point.
            place: place of a mark, in map, m; None = where the robot is.
            yaw: rad; None for the robot's yaw.

        Returns:
            Of a mark its place: ``x``, ``y`` (m) and ``yaw`` (rad) in map.

        Raises:
            RequestRefusedError: why not.
            NotFoundError: the robot, or the point, is not there, or the robot keeps none.
            NoAnswerError: no answer in time.
        """
        x, y = (None, None) if place is None else place
        return await self.call(
            "points", {**await self.header(), "order": order, "name": name, "x": x, "y": y, "yaw": yaw}
        )

    async def zone(
        self, order: ZoneOrder, name: str, area: ZoneArea | None = None, seconds: float = OFF_FOR
    ) -> dict[str, Any]:
        """Add or remove a zone, or turn one on, or off for a while; all are on ``state/zones``.

        Args:
            order: what.
            name: name of the zone.
            area: polygon of a new zone.
            seconds: how long it is off (s).

        Raises:
            RequestRefusedError: why not.
            NotFoundError: the robot, or the zone, is not there, or the robot keeps none.
            InputError: the zone is one of the configuration's.
            NoAnswerError: no answer in time.
        """
        polygon = None if area is None else area.model_dump(mode="json")
        return await self.call(
            "zones", {**await self.header(), "order": order, "name": name, "area": polygon, "seconds": seconds}
        )

    async def mission(
        self, order: MissionOrder, mission: Mission | None = None, *, moved: bool = False, own: bool = False
    ) -> dict[str, Any]:
        """Start a mission, resume one, or end it; answers with its ``number``. Progress is on ``plan/mission``.

        Args:
            order: what.
            mission: to be started.
            moved: resume it although the robot is not where it was interrupted.
            own: of a stop: only one that this client started, or resumed.

        Raises:
            RequestRefusedError: why it does not start, or none runs.
            NotFoundError: the robot is not there, or does no missions.
            NoAnswerError: no answer in time.
        """
        steps = None if mission is None else mission.model_dump(mode="json")
        wanted = {"order": order, "mission": steps, "moved": moved, "own": own}
        return await self.call("mission", {**await self.header(), **wanted})

    async def start_path(self, name: str) -> str:
        """Have the armed robot drive the path of its configuration once; returns the name under which it is followed.

        Raises:
            RequestRefusedError: why it does not start.
            NotFoundError: the robot is not there, or has no such path.
            NoAnswerError: no answer in time.
        """
        return str((await self.call("start_path", {**await self.header(), "path": name}))["path"])

    async def path(self, path: DrivePath, lease: float = 1.0) -> None:
        """Request to follow a path computed here. Raises as ``drive`` does."""
        self._put(REQ_PATH, PathRequest(**await self.header(lease), frame=path.frame, path=path))

    async def localise(self, map_from_odom: tuple[float, float, float], lease: float = 1.0) -> None:
        """Tell a robot with ``slam.mode: ros2`` the pose of odom in map (m, m, rad); it stands for ``lease`` seconds.

        Raises as ``drive`` does.
        """
        x, y, yaw = map_from_odom
        correction = Pose2D(x=x, y=y, yaw=yaw)
        self._put(REQ_LOCALISATION, LocalisationRequest(**await self.header(lease), correction=correction))

    async def send_map(self, packed: bytes, size: tuple[int, int], resolution: float, origin: Pose2D) -> None:
        """Send a map to a robot with ``slam.mode: ros2``. Raises as ``drive`` does.

        Args:
            packed: see ``MapRequest.packed``.
            size: width and height in cells.
            resolution: m.
            origin: origin of the corner of the first cell in map.
        """
        width, height = size
        request = MapRequest(
            **await self.header(), resolution=resolution, width=width, height=height, origin=origin, packed=packed
        )
        self._put(REQ_MAP, request)

    def _put(self, topic: Topic[M], message: M, key: Callable[[str, str], str] | None = None) -> None:
        assert topic.writer is Writer.OUTSIDE
        # Requests overtake everything else on the link, and an order is never dropped for lack of room.
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
        """Wait until the robot's nonce is known: until then requests wait and age.

        Raises:
            NoAnswerError: it did not come in time.
        """
        async with self._asking:  # one task at a time waits for it
            gate = self._followed_gate()
            if gate.latest is None:
                try:
                    async with self._clock.deadline(self._timeout):
                        await gate.next()
                except TimeoutError:
                    msg = f"robot {self.robot!r} does not publish its gate state at {self.endpoint}"
                    raise NoAnswerError(msg) from None

    async def header(self, lease: float = 1.0) -> dict[str, Any]:
        """Header of a request once the robot's nonce is known; raises as ``ready`` does."""
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
            await in_daemon_thread(session.close)  # also at the program's end, when pools take nothing any more

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
            waited = (self._clock.now() - began) / SECOND  # longer than ``timeout`` where the computer is busy
            msg = f"no robot answers at {self.endpoint} within {waited:.1f} s: is its daemon running there "
            msg += "(`monstertruckd run`, or `simulate --run`), or is it elsewhere (--endpoint)?"
            raise NotFoundError(msg) from error

    def _take_name(self, owner: str) -> None:
        if not self._named:
            self.source = own_source(owner)
        elif self.source.partition(":")[0] != owner:
            raise NotPermittedError(
                f"source {self.source!r}: the certificate is that of {owner!r}; expected this name, or one that begins "
                f"with {owner}:"
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
        """All replies of a query, gathered without blocking the loop."""
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
        """That the robot is not there, and which ones are; or that it is, and does not answer."""
        look = 0.5  # seconds that running robots take to answer
        # One that requires certificates shows itself only to who asks for it by name.
        seen = await asyncio.gather(self._seen("*", look), self._seen(self.robot, look))
        names = sorted({name for some in seen for name in some})
        if self.robot in names:
            why = f"it is starting or ending, or takes nothing from {self.source!r}"
            return NoAnswerError(f"robot {self.robot!r} at {self.endpoint} does not answer: {why}")
        there = f"; there {'is' if len(names) == 1 else 'are'} {', '.join(names)} (--robot NAME)" if names else ""
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
    """Bytes of a good reply.

    Raises:
        TruckError: the reply is a refusal.
    """
    if reply.ok is not None:
        return reply.ok.payload.to_bytes()
    assert reply.err is not None
    raise _refusal(reply.err.payload.to_bytes())


def _refusal(data: bytes) -> TruckError:
    """Error from an error reply; Zenoh's own replies are plain text."""
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
