"""The composition root: builds everything from the configuration and runs it in nested scopes.

From the outside in: bus, recorder, actuator links, gate, sensors, estimation, planners. They end in the opposite
order, so the gate commands neutral while actuators and recorder still listen.
"""

import asyncio
import dataclasses
import secrets
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from monstertruck_drivers.catalog import Duty
from monstertruck_drivers.computer import Computer
from monstertruck_drivers.epos.config import EposConfig
from monstertruck_drivers.link import Port
from monstertruck_drivers.maestro.config import MaestroConfig
from monstertruck_estimation.slam.service import SlamService
from monstertruck_kinematics.chassis import Chassis
from monstertruck_planners.steps import CODEC
from monstertruck_runtime.actors.actor import ActorFactory
from monstertruck_runtime.actors.remote import RPC as REMOTE_STEP
from monstertruck_runtime.actors.remote import RemoteWorkQueue
from monstertruck_runtime.clock import Clock, VirtualClock
from monstertruck_runtime.errors import ConfigError, InputError
from monstertruck_runtime.mailbox import latest
from monstertruck_runtime.ports import EventSink, Handler, ServesCalls
from monstertruck_runtime.service import OnBug, RestartPolicy, Scope, Service, scope, supervise
from monstertruck_runtime.slowness import SlowComputer, factor_of
from monstertruck_runtime.threads import Offload, in_daemon_thread, in_thread, inline
from monstertruck_schemas import topics
from monstertruck_schemas.event import CALL_TEXT, Call, Severity
from monstertruck_schemas.health import ServiceHealth, ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import GoalRequest
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.topics import TOPICS, Topic, Writer
from monstertruckd.assembly.devices import Cabling, build_drivers, measures_battery, of_duty, sensor_services
from monstertruckd.assembly.estimation import Body, build_estimation, build_slam
from monstertruckd.assembly.planning import build_planners, build_zones
from monstertruckd.bus.local import Bus, Tap
from monstertruckd.bus.peers import PeerService, PeerSubscriber
from monstertruckd.bus.rpc import Rpc
from monstertruckd.bus.zenoh_session import ZenohBridge
from monstertruckd.config import calibration_rpc
from monstertruckd.config.calibration import CalibrationStore
from monstertruckd.config.expiry import CalibrationWatch, DistanceCounter
from monstertruckd.config.live import LiveConfig
from monstertruckd.config.load import Tree, resolved
from monstertruckd.config.proposal import SteeringProposal
from monstertruckd.config.start import LeftOut, set_aside
from monstertruckd.config.truck import TruckConfig
from monstertruckd.gate.core import Gate
from monstertruckd.gate.hand import HandService
from monstertruckd.gate.latch import EstopLatch, Latch, MemoryLatch, marks_folder
from monstertruckd.gate.service import GateOutputs, GateService, register_gate_calls
from monstertruckd.host.health import ClockService, HealthBoard, MeterService, ServiceCalls
from monstertruckd.host.journal import published
from monstertruckd.host.notify import notify_from, status_line
from monstertruckd.host.stall import StallWatch
from monstertruckd.host.versions import running_versions
from monstertruckd.recorder.black_box import BlackBox
from monstertruckd.recorder.recorder import LogDigest, Recorder
from monstertruckd.recorder.recordings import Recordings

STOPPED: Final = "the emergency stop is latched until an operator resets it"
"""Consequence of a file that is left out."""


class Daemon:
    """Daemon of one robot; ``run`` it once.

    Args:
        config: configuration of the robot.
        clock: wall or virtual time.
        ports: serial ports by device role, instead of the configured ones.
        computer: USB tree, kernel files and disk of its computer; default: those under ``config.machine``.
        tree: file and line of every configured value, stored with the log.
        seed: None for a real run. Otherwise the seed of all random numbers of a run on the virtual clock, without Zenoh
            and without a latch file; only its log remains.
        environment: environment variables that systemd sets: ``NOTIFY_SOCKET``, ``WATCHDOG_USEC``,
            ``RUNTIME_DIRECTORY``.
        left_out: unusable files; any of them latches the emergency stop until an operator clears it.
    """

    def __init__(
        self,
        config: TruckConfig,
        clock: Clock,
        *,
        ports: Mapping[str, Port] | None = None,
        computer: Computer | None = None,
        tree: Tree | None = None,
        seed: int | None = None,
        environment: Mapping[str, str] = MappingProxyType({}),
        left_out: Sequence[LeftOut] = (),
    ) -> None:
        self.config = config
        self.clock = clock
        self.bus = Bus(clock, config.zenoh.gather_seconds)
        self.digest = LogDigest()
        self._seed = seed
        self._left_out = tuple(left_out)
        self._offload: Offload = in_thread if seed is None else inline
        self._rng = np.random.default_rng(seed)
        self._nonce = secrets.token_hex(8) if seed is None else self._rng.bytes(8).hex()
        """Identity of this run: carried by requests and by saved maps."""
        self._tree = tree
        self._events = self.bus.event_sink()
        self._computer = computer or Computer.at(config.machine, clock)
        self._cabling = Cabling(config, self._computer, self.bus, ports or {})
        self._board = HealthBoard(
            clock,
            self.bus.publisher(topics.HEALTH, Writer.DAEMON),
            self._events,
            self._cabling.waiting,
            self._cabling.on_hubs,
        )
        self._drivers = build_drivers(config, self._cabling, self._computer, clock, self.bus)
        self._body = Body.of(config)
        self.gate = self._build_gate(environment)
        self.bus.listen(topics.REQ_CONTROL, self.gate.control)
        self.bus.listen(topics.REQ_DRIVE, self.gate.request)
        self.bus.listen(topics.PLAN_DRIVE, self.gate.planner_request)
        self.bus.listen(topics.EVENT, self.gate.observe_event)
        self.bus.listen(topics.HEALTH, self.gate.observe_health)
        self.bus.listen(topics.EVENT, self._board.observe_event)
        if config.own_planner is None:
            self.bus.listen(topics.REQ_GOAL, self._refuse_goal)
        self.peers = PeerService(clock, self.bus.publisher(topics.PEERS, Writer.ESTIMATION)) if config.peers else None
        """Publishes the poses received from other robots."""
        self._remote_steps = RemoteWorkQueue(CODEC)
        if config.placement.slowness is not None and not isinstance(clock, VirtualClock):
            raise ConfigError("placement.slowness: supported on the virtual clock only, not for a daemon in real time")
        self.slow: SlowComputer | None = None
        """Delays all computations in a study (``placement.slowness``)."""
        self._actors = ActorFactory(clock, self._remote_steps)
        self._calibration = self._build_calibration()
        self.rpc = self._build_rpc()
        self._attachments = _attachments(config, self._body, tree)
        self._attachments["calibration"]["wizards"] = [
            state.model_dump(mode="json", exclude={"metres_left"}) for state in self._calibration.states()
        ]
        self.recorder = self._build_recorder()
        self.black_box = self._build_black_box()
        self._notify = notify_from(environment, clock, self.gate.ticks, config.gate.rate, self._status)

    def worker_pids(self) -> dict[str, int]:
        """Process numbers of the workers that run, by name."""
        return self._actors.worker_pids()

    async def run(self, stop: asyncio.Event) -> None:
        """Run until ``stop`` is set, then end everything inside-out, neutral first.

        Raises:
            BusyError: another daemon runs this robot or holds the endpoint.
            BaseExceptionGroup: a bug in gate, actuators or bus.
        """
        if (slowness := self.config.placement.slowness) is not None and isinstance(self.clock, VirtualClock):
            self.slow = SlowComputer(self.clock, factor_of(slowness))
        async with (
            self._outside(),
            self._recording(),
            scope("actuators") as actuators,
            scope("gate") as gate,
            scope("sensors") as sensors,
            scope("estimation") as estimation,
            scope("planners") as planners,
        ):
            self._say_what_is_left_out()
            self._start_drivers(actuators, OnBug.EXIT, Duty.ACTUATOR)
            self._start(gate, self.gate, OnBug.EXIT)
            if self.config.devices.hand is not None:
                self._start(gate, self._hand_service())
            self._start(gate, self._calibration)
            self._start(gate, MeterService(self.clock, self.gate, self.recorder, self.bus, self._events))
            if self._seed is None:
                self._start(gate, StallWatch(self.clock, self.gate.ticks, self.config.state_directory / "stalls"))
            self._start_drivers(sensors, OnBug.FAIL, Duty.SENSOR, Duty.MONITOR)
            slam = build_slam(self.config, self.bus, self.clock, self._nonce)
            parts = (self.config, self.bus, self.clock, self._body, self._actors)
            for service in build_estimation(*parts, slam, self._nonce):
                self._start_serving(estimation, service)
            for service in self._peer_services():
                self._start(estimation, service)
            if (zones := build_zones(self.config, self.bus, self.clock, self._body)) is not None:
                self._start_serving(planners, zones)
            for service in build_planners(*parts, slam.save_soon if isinstance(slam, SlamService) else None):
                self._start_serving(planners, service)
            if self._notify is not None:
                self._notify.up()
            await stop.wait()
            if self._notify is not None:
                self._notify.stopping()
            self.gate.shut_down()

    # The scopes' contents

    def _hand_service(self) -> HandService:
        """Build the service that drives by the operator's radio control."""
        return HandService(
            self.config.hand,
            self.clock,
            self.bus.subscribe(topics.HAND, latest()),
            self.bus.subscribe(topics.GATE, latest()),
            self.bus.inject,
            self._events,
            steered=self._body.chassis.steered,
        )

    def _peer_services(self) -> Iterator[Service]:
        """Services that receive the poses of other robots; on the virtual clock nothing comes over Zenoh."""
        if self.peers is None:
            return
        yield self.peers
        if self._seed is None:
            for robot, where in self.config.peers.items():
                yield PeerSubscriber(robot, where, self.clock, self.peers)

    @asynccontextmanager
    async def _outside(self) -> AsyncIterator[None]:
        log_out = self.bus.publisher(topics.LOG, Writer.DAEMON)
        with published(self.clock, log_out, self.bus.add_drops, reproducible=self._seed is not None):
            async with AsyncExitStack() as after, scope("bus") as bus_scope:
                await self._start_outside(bus_scope)
                after.push_async_callback(self.gate.close)  # from here on this is the robot's only daemon
                yield

    async def _start_outside(self, bus_scope: Scope) -> None:
        if self._seed is None:
            bridge = ZenohBridge(
                self.config.robot,
                self.bus,
                self.config.zenoh,
                self.clock,
                self.rpc,
                stand=self.config.stand != "none",
            )
            await bridge.open()
            self._left_out = await set_aside(self._left_out, self.gate.store_latch, self._offload)
            self._start(bus_scope, bridge, OnBug.EXIT)
        self._start(bus_scope, ClockService(self.clock, self.bus.publisher(topics.CLOCK, Writer.DAEMON), self._events))
        self._start(bus_scope, self._board)
        if self._cabling.service is not None:
            self._start(bus_scope, self._cabling.service)
        if self._notify is not None:
            self._start(bus_scope, self._notify)

    @asynccontextmanager
    async def _recording(self) -> AsyncIterator[None]:
        """Recorder and black box; the log file is closed before a black box that is written at shutdown.

        The black box stops first, because closing the log file takes real time; it contains no messages of that time.
        """
        recorder, box = self.recorder, self.black_box
        async with AsyncExitStack() as after:
            if box is not None:
                await after.enter_async_context(box)
            if recorder is not None:
                await after.enter_async_context(recorder)
                self._board.report(ServiceHealth(name=recorder.name, state=ServiceState.READY, since=self.clock.now()))
                after.callback(self._tap(recorder.record).close)
            if box is not None:
                after.callback(box.freeze)
                after.callback(self._tap(box.record).close)
            yield

    def _say_what_is_left_out(self) -> None:
        for _, source, text in self._left_out:
            self._events(Reason.FILE_DAMAGED, Severity.WARNING, source, f"{text}; {STOPPED}")

    def _tap(self, record: Callable[[Topic[Any], int, bytes, int], None]) -> Tap:
        """Hands everything that is logged to ``record``."""
        return self.bus.tap(
            lambda topic, message, data, at: record(topic, message.stamp, data, at),
            (topic for topic in TOPICS if topic.logged),
        )

    def _status(self) -> str:
        return status_line(self.gate.mode, self._board.rows())

    def _recorder_failed(self, reason: Reason, text: str) -> None:
        self._board.report(
            ServiceHealth(
                name="recorder", state=ServiceState.FAILED, since=self.clock.now(), reason=reason, detail=text
            )
        )

    def _start(
        self, where: Scope, service: Service, on_bug: OnBug = OnBug.FAIL, policy: RestartPolicy | None = None
    ) -> None:
        rng = np.random.default_rng(self._rng.integers(2**63))
        work = supervise(service, policy or RestartPolicy(), self.clock, self._board.report, rng, on_bug)
        where.start(service.name, work if self.slow is None else self.slow.service(service.name, work))

    def _start_serving(self, where: Scope, service: Service) -> None:
        """Start a service and its remote calls, which are refused once it has failed for good."""
        self._start(where, service)
        if isinstance(service, ServesCalls):
            service.register(ServiceCalls(self.rpc, self._board, service.name))

    def _start_drivers(self, where: Scope, on_bug: OnBug, *duties: Duty) -> None:
        devices = self.config.devices.present()
        for role, driver in of_duty(self._drivers, *duties).items():
            self._start(where, driver, on_bug, devices[role].restart if role in devices else None)

    def _build_rpc(self) -> Rpc:
        rpc = Rpc(self.clock, record=recording(self.bus, self.clock))

        live = LiveConfig(self.config, self._reconfigure, self._events, self._offload)

        async def config(_: dict[str, Any]) -> dict[str, Any]:
            return resolved(live.config)

        async def versions(_: dict[str, Any]) -> dict[str, Any]:
            return dict(running_versions())

        rpc.register("config", config, AccessRole.OBSERVER, recorded=False)
        rpc.register("versions", versions, AccessRole.OBSERVER, recorded=False)
        live.register(rpc)
        rpc.register("acknowledge", acknowledging(self._events))
        self._recordings().register(rpc)
        rpc.register(REMOTE_STEP, self._remote_steps.serve, recorded=False)
        register_gate_calls(rpc, self.bus, self.clock)
        loaded = self._tree.calibration if self._tree is not None else None
        calibration_rpc.register(
            rpc,
            self.config,
            loaded,
            self.clock,
            self._events,
            self._offload,
            lambda: self.gate.mode,
            self._calibration,
        )
        return rpc

    def _recordings(self) -> Recordings:
        recorder, boxes = self.config.recorder, self.config.black_box_folder
        folders = {} if recorder is None else {"run": Path(recorder.directory)}
        if boxes is not None:
            folders["blackbox"] = boxes
        written = lambda: None if self.recorder is None else self.recorder.path  # noqa: E731  # it comes later
        return Recordings(folders, written, self.clock, self._events, self._offload)

    def _reconfigure(self, config: TruckConfig) -> None:
        self.gate.configure(config.gate, config.weakened())

    def _refuse_goal(self, request: GoalRequest) -> None:
        why = "this robot follows given paths and has no planner to find a route"
        if self.config.planner is not None:
            why = "ROS 2 plans for this robot (planner.mode ros2): send the goal to Nav2"
        text = f"goal of {request.source} refused: {why}"
        self._events(Reason.NOT_SUPPORTED, Severity.WARNING, "daemon", text)

    # Building

    def _build_gate(self, environment: Mapping[str, str]) -> GateService:
        config, bus = self.config, self.bus
        latch = self._build_latch(environment)
        gate = Gate(
            config.gate,
            chassis=self._body.chassis,
            footprint=self._body.footprint,
            points=self._body.points,
            services=sensor_services(config),
            nonce=self._nonce,
            battery_measured=measures_battery(config),
            latched=latch.engaged() or bool(self._left_out),
            sonars=self._body.sonars,
            rear_sonars=self._body.rear_sonars,
            peers=self._body.peers,
            compared=True,
            zones=config.zones,
            docks=config.docks,
            own=config.checks,
        )
        shafts = len(self._body.chassis.shafts)
        drives, steering = bus.actuators(shafts)
        return GateService(
            gate,
            config.gate.rate,
            self.clock,
            {topic: bus.subscribe(topic, latest()) for topic in gate.reads},
            GateOutputs(
                drives,
                steering,
                bus.publisher(topics.GATE, Writer.GATE),
                bus.publisher(topics.STOP, Writer.GATE),
                bus.publisher(topics.SEEN, Writer.GATE),
            ),
            self._events,
            latch,
            black_box=lambda trip: None if self.black_box is None else self.black_box.trip(trip),
            offload=self._offload,
            weakened=config.weakened(),
            cut_ports=self._cabling.cut,
        )

    def _build_calibration(self) -> CalibrationWatch:
        loaded = self._tree.calibration if self._tree is not None else None
        results = {} if loaded is None else CalibrationStore(loaded.parent, self.config.robot).load(loaded).results
        file = self.config.state_directory / "odometer.json" if self._seed is None else None
        kept = None if file is None else self.config.state_directory / "proposed_calibration.json"
        proposal = SteeringProposal(self.config, "" if loaded is None else str(loaded), kept)
        return CalibrationWatch(
            self.config, results, self.bus, self.clock, self._events, self._offload, DistanceCounter(file), proposal
        )

    def _build_latch(self, environment: Mapping[str, str]) -> Latch:
        if self._seed is not None:
            return MemoryLatch()
        marks = marks_folder(self.config.runtime_directory, environment)
        latch = EstopLatch(self.config.state_directory / "estop", marks)
        try:
            latch.prepare()
        except OSError as error:
            msg = f"state_directory, runtime_directory: an emergency stop could not be remembered: {error}"
            raise ConfigError(msg) from error
        return latch

    def _build_recorder(self) -> Recorder | None:
        if self.config.recorder is None:
            return None
        return Recorder(
            self.config.recorder,
            self.clock,
            self._recorder_failed,
            attachments=self._attachments,
            digest=self.digest if self._seed is not None else None,
            deterministic=self._seed is not None,
            on_repair=self._log_repaired if self._seed is None else None,
        )

    def _log_repaired(self, text: str) -> None:
        self._events(Reason.LOG_DAMAGED, Severity.WARNING, "recorder", text)

    def _build_black_box(self) -> BlackBox | None:
        folder = self.config.black_box_folder
        if self.config.blackbox is None or folder is None:
            return None
        return BlackBox(
            self.config.blackbox,
            folder,
            self.clock,
            self._events,
            attachments=self._attachments,
            metadata={"robot": self.config.robot},
            offload=in_daemon_thread if self._seed is None else inline,
            log=lambda: None if self.recorder is None else self.recorder.path,
        )


def recording(bus: Bus, clock: Clock) -> Callable[[str, str, str, Reason, str], None]:
    """Return a callback that publishes every answered call as ``event/call``."""
    out = bus.publisher(topics.CALL, Writer.DAEMON)

    def record(name: str, source: str, payload: str, reason: Reason, answer: str) -> None:
        now = clock.now()
        asked, answered = payload[:CALL_TEXT], answer[:CALL_TEXT]
        call = Call(
            stamp=now,
            received=now,
            seq=out.next_seq(),
            name=name,
            source=source,
            payload=asked,
            reason=reason,
            answer=answered,
        )
        out.put(call)

    return record


def acknowledging(events: EventSink) -> Handler:
    """Remote call ``acknowledge``: an operator has seen a warning (``text``), which becomes an event in the log."""
    longest_warning = 200  # characters of a warning that is acknowledged

    async def acknowledge(payload: dict[str, Any]) -> dict[str, Any]:
        text, by = payload.get("text"), str(payload.get("source", ""))
        if not isinstance(text, str) or not text or len(text) > longest_warning or not text.isprintable():
            raise InputError(f"text: expected 1 to {longest_warning} printable characters")
        events(Reason.ACKNOWLEDGED, Severity.INFO, "operator", f"{by} acknowledged: {text}", by=by)
        return {}

    return acknowledge


def _attachments(config: TruckConfig, body: Body, tree: Tree | None) -> dict[str, Any]:
    """Attachments of a log: configuration, calibration, origins of the values, versions."""
    origins = tree.origins if tree is not None else {}
    return {
        "config": resolved(config),
        "calibration": _calibration(config, body.chassis, tree),
        "origins": {".".join(map(str, key)): str(origin) for key, origin in origins.items()},
        "versions": dict(running_versions()),
    }


def _calibration(config: TruckConfig, chassis: Chassis, tree: Tree | None) -> dict[str, Any]:
    """All calibrated values of this robot and the file they come from, for the log."""
    devices = config.devices
    values: dict[str, Any] = {
        "file": None if tree is None or tree.calibration is None else str(tree.calibration),
        "wheel_radius_m": config.geometry.wheel_radius,
        "drive_ratio": config.geometry.drive_ratio,
        "linkage": None if chassis.linkage is None else dataclasses.asdict(chassis.linkage),
        "mounts": {role: device.mount.model_dump() for role, device in devices.present().items()},
    }
    values |= {
        f"{role}_inverted": device.driver.inverted
        for role, device in devices.shafts().items()
        if isinstance(device.driver, EposConfig)
    }
    if devices.steering is not None and isinstance(steering := devices.steering.driver, MaestroConfig):
        values |= {"front_servo": steering.front.model_dump(), "rear_servo": steering.rear.model_dump()}
        if steering.battery is not None:
            values["battery"] = steering.battery.model_dump()
    return values
