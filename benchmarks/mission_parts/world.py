"""The mission service with services that end their tasks according to a script."""

import asyncio
import json
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from ruamel.yaml import YAML

from benchmarks.mission_parts.generator import BREAK_AFTER, CHANGE_AFTER, SECONDS, Script
from benchmarks.mission_parts.interpreter import Outcome
from monstertruck_planners.missions.service import MissionInputs, MissionParts, MissionService
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.threads import inline
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.mission import Mission
from monstertruck_schemas.plan import GoalPhase, GoalState
from monstertruck_schemas.points import PointKind
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import GoalControl, MissionOrder, MissionRequest, Role


class _Robot:
    noun = "goal"

    def __init__(self, clock: VirtualClock, script: Script, file: Path) -> None:
        self.clock, self.script, self.file, self.tasks = clock, script, file, self
        self.visit = self.number = self.seq = self.restarts = self.interruptions = 0
        self.steps: list[str] = []
        self.pending: list[asyncio.TimerHandle] = []
        self.goal_end: asyncio.TimerHandle | None = None
        self.wanted: str | None = None
        self.latest: dict[str, Any] = dict.fromkeys(
            ("gate", "pose", "goal", "behaviour", "explore", "points", "battery")
        )
        gate = SimpleNamespace(nonce="n", stamp=0, reasons=(), worst=Reason.ESTOPPED, why="estopped")
        gate.mode = SimpleNamespace(active=True)
        self.latest |= {"gate": gate, "points": SimpleNamespace(points=())}
        self.change("charge", 50.0)

    def begin(self) -> MissionService:
        def box(name: str) -> Any:
            return type("Box", (), {"latest": property(lambda _: self.latest[name])})()

        return MissionService(
            MissionParts(self, None, None),  # type: ignore[arg-type]
            self.clock, file=self.file, localised=True, offload=inline, max_age=5.0,
            inputs=MissionInputs(**{name: box(name) for name in self.latest}),
            state=SimpleNamespace(next_seq=lambda: 1, put=lambda _: None),  # type: ignore[arg-type]
            events=self.event,
        )  # fmt: skip

    def event(self, reason: Reason, severity: Any, source: str, text: str = "", **values: Any) -> None:
        del severity, source, values
        if reason is not Reason.MISSION_STEP:
            return
        doing = text.partition(": ")[2]
        if doing.endswith("interrupted by a watch"):
            self.interruptions += 1
            return
        self.steps.append(_label(doing))
        self.visit += 1
        for handle in self.pending:
            handle.cancel()
        loop, visit = asyncio.get_running_loop(), self.visit
        self.pending = []
        if visit in self.script.changes:
            self.pending.append(loop.call_later(CHANGE_AFTER, self.change, *self.script.changes[visit]))
        if visit == self.script.estop:
            self.pending.append(loop.call_later(BREAK_AFTER, self.estop))
        elif visit in self.script.restarts:
            self.pending.append(loop.call_later(BREAK_AFTER, self.restart, self.script.restarts[visit]))

    def change(self, key: str, value: Any) -> None:
        if key == "charge":
            self.latest["battery"] = SimpleNamespace(received=10**18, charge=value / 100.0)
        else:
            points = tuple(SimpleNamespace(name=name, kind=PointKind.MARK) for name in value)
            self.latest["points"] = SimpleNamespace(points=points)

    def estop(self) -> None:
        self.latest["gate"].mode = SimpleNamespace(active=False)
        if self.goal_end is not None:
            self.goal_end.cancel()
            self.say(GoalPhase.IDLE, Reason.ESTOPPED)

    def restart(self, how: str) -> None:
        self.restarts += 1
        self.wanted = how

    # The goal service's task server

    def take(self, request: Any) -> int:
        if isinstance(request, GoalControl):
            if self.goal_end is not None:
                self.goal_end.cancel()
            self.say(GoalPhase.IDLE, Reason.CANCELLED)
            return self.number
        self.number += 1
        self.say(GoalPhase.DRIVING, Reason.DRIVING)
        end = Reason.GOAL_UNREACHABLE if self.visit in self.script.fails else Reason.GOAL_REACHED
        self.goal_end = asyncio.get_running_loop().call_later(SECONDS - 0.25, self.say, GoalPhase.IDLE, end)
        return self.number

    def hold(self, _who: str, *, on: bool) -> None:
        pass

    def say(self, phase: GoalPhase, reason: Reason) -> None:
        header: dict[str, Any] = {"stamp": 1, "received": 1, "seq": 0, "frame": "map", "source": "missions"}
        self.latest["goal"] = GoalState(**header, number=self.number, phase=phase, outcome=reason)

    def order(self, service: MissionService, order: MissionOrder, mission: Mission | None = None) -> None:
        self.seq, now = self.seq + 1, self.clock.now()
        self.latest["gate"].stamp = now
        self.latest["pose"] = SimpleNamespace(received=now, pose=Pose2D(x=0.0, y=0.0, yaw=0.0))
        request = MissionRequest(
            stamp=now, received=now, seq=self.seq, source="bench", role=Role.STATION, lease=1.0, nonce="n",
            gate_stamp=now, order=order, mission=mission,
        )  # fmt: skip
        service.tasks.take(request)


def _label(doing: str) -> str:
    words = doing.split()
    match words[0]:
        case "goto":
            return f"goto {words[1]}"
        case "record:":
            return f"record {words[1]}"
        case "wait":
            return "wait_until" if words[1] == "until" else "wait"
        case other:
            return other.rstrip(":")


def read(text: str) -> Mission:
    """Return the mission in a file's text."""
    return Mission.model_validate_json(json.dumps(YAML(typ="safe", pure=True).load(text)))


def done(text: str, script: Script) -> Outcome:
    """Run a mission, and return its outcome."""
    mission = read(text)
    with tempfile.TemporaryDirectory(prefix="missions") as folder:
        return run_virtual(lambda clock: _run(clock, mission, script, Path(folder) / "mission.json"), start=SECOND)


async def _run(clock: VirtualClock, mission: Mission, script: Script, file: Path) -> Outcome:
    robot, order = _Robot(clock, script, file), MissionOrder.START
    while True:
        service = robot.begin()
        task = asyncio.create_task(service.run(lambda: None))
        await clock.sleep(0.3)  # seconds of a start
        robot.wanted, robot.goal_end = None, None
        robot.latest["goal"] = None
        robot.order(service, order, mission if order is MissionOrder.START else None)
        await service.kept()
        while service.running and robot.wanted is None:
            await clock.sleep(0.02)
        killed = file.read_bytes() if robot.wanted == "killed" else None
        ended = service.tasks.reported if robot.wanted is None else None
        for handle in robot.pending:
            handle.cancel()
        task.cancel()
        await asyncio.wait([task])
        if robot.goal_end is not None:
            robot.goal_end.cancel()
        if ended is not None:
            return Outcome(ended.outcome.value, robot.steps, robot.restarts, robot.interruptions)
        if killed is not None:
            file.write_bytes(killed)
        order = MissionOrder.RESUME
