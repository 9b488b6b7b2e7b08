"""Files that a datum passes: a scan to the motor and through SLAM, a goal to the tracker, a configuration value.

    python benchmarks/data_paths.py [--files]

The whole daemon runs on the virtual clock, with its workers' steps in the loop. A datum is followed by identity: it
passes every function that receives it as an argument, directly or inside a message, dataclass, tuple or list. The
results of such a function and the objects that it constructs carry the datum on, also to its caller. Where a service
keeps a datum in its state, the path continues with the next message made from that state; these messages are named for
each path. A configuration value is followed by its content instead, because it is parsed on the way, then through the
calls that lead to its first reader.

The figure is the number of distinct files of this project passed in the named services, without the emulated side and
the virtual event loop. ``--files`` lists them in the order in which they are entered, with their lines. The last line
is JSON.
"""

import argparse
import asyncio
import dataclasses
import json
import sys
import tempfile
import traceback
from collections.abc import Callable, Collection
from enum import Enum
from pathlib import Path
from types import FrameType
from typing import Any, Final
from unittest.mock import patch

import numpy as np
from pydantic import BaseModel

import monstertruck_estimation.slam.service as slam_service
from benchmarks import ROOT
from monstertruck_runtime.actors.actor import LoopActor
from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.mailbox import latest
from monstertruck_schemas import topics
from monstertruckd.config.load import load_config, load_truck
from monstertruckd.daemon import Daemon
from monstertruckd.gate.config import GateConfig
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

SOURCES: Final = ("monstertruckd", "drivers", "planners", "schemas")
EMULATED: Final = ("monstertruck_sim/", "runtime/clock.py", "emulator.py", "firmware.py", "cable.py")
GOALS: Final = {"scan_to_motor": 22, "scan_through_slam": 32, "goal_to_tracker": 16, "configuration_value": 5}
PYDANTIC: Final = BaseModel.__init__.__code__.co_filename
SCAN_BYTES: Final = 500
"""More bytes than any answer of the lidar that is no scan."""
STEERING_SIDE: Final = ("/maestro/",)
"""Commands to the motor are followed, those to the servos are not."""
SPEED: Final = 0.1537
"""Value of ``gate.speed`` that is followed; it occurs nowhere else, and the motor can turn so fast."""


def source_file(name: str, known: dict[str, str | None] = {}) -> str | None:  # noqa: B006  # a cache
    """Return the path, from the root, of a file of this project that is not on the emulated side; None for others."""
    if name not in known:
        path = Path(name)
        inside = path.relative_to(ROOT) if path.is_relative_to(ROOT) else None
        counts = inside is not None and inside.parts[0] in SOURCES and not any(part in str(inside) for part in EMULATED)
        known[name] = str(inside) if counts else None
    return known[name]


class Trace:
    """Profile function that notes the files a datum passes.

    Args:
        tasks: suffixes of the names of the followed tasks; "*": unnamed tasks.
        starts: messages whose construction is the datum, or carries it on; "bytes": the bytes of the lidar's line.
        leaves: parts of paths of files at which it has arrived.
    """

    def __init__(self, tasks: Collection[str], starts: Collection[str], leaves: Collection[str] = ()) -> None:
        self.files: list[str] = []
        self._tasks, self._starts, self._leaves = tasks, starts, leaves
        self._carriers: dict[int, Any] = {}
        self._passed: set[FrameType] = set()

    def __call__(self, frame: FrameType, event: str, result: Any) -> None:
        """Process a call or return; called by the interpreter."""
        if event == "call":
            if self._watched(frame) and self._is_given(frame):
                self._note(frame)
        elif event == "return":
            if frame in self._passed:
                self._return(frame, result)
            elif self._watched(frame) and self._begins(frame, result):
                self._note(frame)
                self._return(frame, result)

    def _watched(self, frame: FrameType) -> bool:
        name = frame.f_code.co_filename
        file = source_file(name)
        if (file is None and not _makes(frame)) or self._has_arrived(frame):
            return False
        task = asyncio.current_task()
        who = task.get_name() if task is not None else "Task-0"
        return any(who.endswith(end) or (end == "*" and who.startswith("Task-")) for end in self._tasks)

    def _has_arrived(self, frame: FrameType) -> bool:
        above: FrameType | None = frame
        while self._leaves and above is not None:
            if any(part in above.f_code.co_filename for part in self._leaves):
                return True
            above = above.f_back
        return False

    def _note(self, frame: FrameType) -> None:
        self._passed.add(frame)
        file = source_file(frame.f_code.co_filename)
        if file is not None and file not in self.files:
            self.files.append(file)

    def _is_given(self, frame: FrameType) -> bool:
        code = frame.f_code
        if _makes(frame) and frame.f_back in self._passed:
            return True  # a message made where the datum is
        count = code.co_argcount + code.co_kwonlyargcount + bool(code.co_flags & 4) + bool(code.co_flags & 8)
        values = {name: frame.f_locals.get(name) for name in code.co_varnames[:count]}
        own = values.pop("self", None)
        return id(own) in self._carriers or any(map(self._holds, values.values()))

    def _holds(self, value: Any) -> bool:
        inner = value if isinstance(value, tuple | list) else value.values() if isinstance(value, dict) else ()
        return id(value) in self._carriers or (len(inner) <= 64 and any(id(part) in self._carriers for part in inner))

    def _begins(self, frame: FrameType, result: Any) -> bool:
        if frame.f_code.co_name == "__init__":
            return type(frame.f_locals.get("self")).__name__ in self._starts
        scan = isinstance(result, bytes | bytearray) and len(result) > SCAN_BYTES
        return scan and "bytes" in self._starts and frame.f_code.co_filename.endswith("link.py")

    def _return(self, frame: FrameType, result: Any) -> None:
        self._passed.discard(frame)
        made = frame.f_locals.get("self") if frame.f_code.co_name == "__init__" else result
        self._carry(made)
        above = frame.f_back
        if above is not None and id(made) in self._carriers and self._watched(above) and above.f_code.co_name != "run":
            self._note(above)

    def _carry(self, value: Any, depth: int = 3) -> None:
        if id(value) in self._carriers or (isinstance(value, tuple | bytes) and not value):  # of which there is one
            return
        if isinstance(value, tuple | list):
            parts: Collection[Any] = value
        elif isinstance(value, bytes | bytearray | np.ndarray | np.generic) or (
            isinstance(value, float) and value not in (0, 1)
        ):
            parts = ()
        elif isinstance(value, BaseModel) or (dataclasses.is_dataclass(value) and not isinstance(value, Enum | type)):
            names = (
                type(value).model_fields
                if isinstance(value, BaseModel)
                else [f.name for f in dataclasses.fields(value)]
            )
            found = [getattr(value, name, None) for name in names]
            parts = [part for part in found if isinstance(part, tuple | list | np.ndarray | bytes)]
        else:
            return
        self._carriers[id(value)] = value
        if depth:
            for part in parts:
                self._carry(part, depth - 1)


def _makes(frame: FrameType) -> bool:
    """Whether a library function constructs a message or dataclass."""
    code = frame.f_code
    return code.co_filename == PYDANTIC or (code.co_filename == "<string>" and code.co_name == "__init__")


class ContentTrace(Trace):
    """Follows a configuration value by its content: as text, number, or part of a section."""

    def __init__(self) -> None:
        super().__init__((), ())

    def _watched(self, frame: FrameType) -> bool:
        return source_file(frame.f_code.co_filename) is not None

    def _is_given(self, frame: FrameType) -> bool:
        code = frame.f_code
        names = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
        return any(self._says(frame.f_locals.get(name)) for name in names if name != "self")

    def _begins(self, frame: FrameType, result: Any) -> bool:
        return self._says(result)

    def _return(self, frame: FrameType, result: Any) -> None:
        self._passed.discard(frame)

    def _says(self, value: Any, depth: int = 4) -> bool:
        if isinstance(value, str | bytes):
            return str(SPEED) in str(value)
        if isinstance(value, float):
            return value == SPEED
        if isinstance(value, BaseModel) or dataclasses.is_dataclass(value):
            value = {name: getattr(value, name, None) for name in getattr(value, "__dict__", ())}
        parts = value.values() if isinstance(value, dict) else value if isinstance(value, tuple | list) else ()
        return depth > 0 and any(self._says(part, depth - 1) for part in parts)


class StepInLoop(LoopActor):
    """Replaces the SLAM worker, so that its step runs in this process."""

    pid = 1

    def __init__(self, _: str, target: str, clock: VirtualClock, *, latency: float, **__: float) -> None:
        super().__init__(target, clock, latency)


def robot(name: str, **sections: Any) -> SimulatedTruckConfig:
    """Return a shipped configuration without recordings."""
    values = load_config(ROOT / "configs" / f"{name}.yaml", SimulatedTruckConfig)[0].model_dump()
    values |= {"recorder": None, "blackbox": None, **sections}
    return SimulatedTruckConfig.model_validate(values)


def traced(
    config: SimulatedTruckConfig, trace: Trace, seconds: float, goal: tuple[float, float, float] | None = None
) -> list[str]:
    """Return the files that a datum passes while the robot drives, or plans a route to a goal."""

    async def main(clock: VirtualClock) -> None:
        rig = VirtualRig(config, clock)
        async with rig.running():
            await clock.sleep(3.0)
            await LocalOperator(rig.daemon, clock).arm()
            await clock.sleep(3.0)
            gate, now = (
                rig.bus.subscribe(topics.GATE, latest()).latest
                or await rig.bus.subscribe(topics.GATE, latest()).next(),
                clock.now(),
            )
            sys.setprofile(trace)
            try:
                if goal is not None:
                    x, y, yaw = goal
                    request = {
                        "stamp": now,
                        "received": now,
                        "seq": 1,
                        "source": "tracer",
                        "role": "station",
                        "lease": 1.0,
                    }
                    request |= {
                        "nonce": gate.nonce,
                        "gate_stamp": gate.stamp,
                        "frame": "map",
                        "goal": {"x": x, "y": y, "yaw": yaw},
                    }
                    await rig.daemon.rpc.call("goal", request)
                await clock.sleep(seconds)
            finally:
                sys.setprofile(None)

    run_virtual(main)
    return trace.files


def scan_to_motor() -> list[str]:
    """Follow a scan that limits the tracker's request."""
    tasks = ("/lidar", "/tracker", "/gate", "/drive")
    return traced(robot("demo"), Trace(tasks, ("bytes", "DriveCommand"), STEERING_SIDE), 0.3)


def scan_through_slam() -> list[str]:
    """Follow a scan that moves the pose used by the tracker."""
    tasks = ("/lidar", "/slam", "/tracker", "/gate", "/drive", "*")
    trace = Trace(
        tasks,
        ("bytes", "ScanInput", "WorkerInput", "WorkerOutput", "Estimate", "DriveRequest", "DriveCommand"),
        STEERING_SIDE,
    )
    with patch.object(slam_service, "WorkerActor", StepInLoop):
        return traced(robot("slam"), trace, 1.0)


def goal_to_tracker() -> list[str]:
    """Follow a goal that becomes a route, and then a path around obstacles, which the tracker accepts."""
    starts = ("GoalRequest", "PlanTask", "RouteAnswer", "DeformTask", "DeformAnswer", "Path")
    config = robot("goals", placement={"planner": "loop", "local_planner": "loop"})
    trace = Trace(("/goals", "*"), starts)
    return traced(config, trace, 1.0, goal=(3.0, 2.0, 0.0))


def configuration_value() -> list[str]:
    """Follow the gate's maximum speed from the line in the file to the gate."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "robot.yaml"
        file.write_text(f"include: {ROOT / 'configs' / 'demo.yaml'}\ngate: {{speed: {SPEED}}}\n", encoding="utf-8")
        trace, readers = ContentTrace(), []

        def read(config: GateConfig, name: str) -> Any:
            if name == "speed":
                readers.append([frame.f_code.co_filename for frame, _ in traceback.walk_stack(None)])
            return object.__getattribute__(config, name)

        async def main(clock: VirtualClock) -> None:
            sys.setprofile(trace)
            config = load_truck(file)[0]
            sys.setprofile(None)
            with patch.object(GateConfig, "__getattribute__", read):
                Daemon(config, clock, seed=1)

        run_virtual(main)
        stack = [found for name in reversed(readers[0]) if (found := source_file(name)) is not None]
        return list(dict.fromkeys([*trace.files, *stack[1:]]))  # below the loop that runs this


WAYS: Final[dict[str, Callable[[], list[str]]]] = {
    "scan_to_motor": scan_to_motor,
    "scan_through_slam": scan_through_slam,
    "goal_to_tracker": goal_to_tracker,
    "configuration_value": configuration_value,
}


def main() -> None:
    """Print the number of files on each path as a table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--files", action="store_true", help="list the files of each way")
    arguments = parser.parse_args()
    figures: dict[str, int] = {}
    print("| way | files | goal | longest files, lines |\n|---|---|---|---|")
    for name, follow in WAYS.items():
        files = follow()
        figures[name] = len(files)
        lines = {file: len((ROOT / file).read_text(encoding="utf-8").splitlines()) for file in files}
        longest = sorted(files, key=lines.__getitem__, reverse=True)[:3]
        shown = ", ".join(f"`{Path(file).parent.name}/{Path(file).name}` {lines[file]}" for file in longest)
        print(f"| {name.replace('_', ' ')} | {len(files)} | {GOALS[name]} | {shown} |")
        if arguments.files:
            print("\n".join(f"    {lines[file]:5d} {file}" for file in files))
    met = all(figures[name] <= goal for name, goal in GOALS.items())
    print(json.dumps({"bench": "data_paths", "figures": figures, "goals": GOALS, "met": met}))


if __name__ == "__main__":
    main()
