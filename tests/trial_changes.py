"""Changes that a newcomer makes, each written out: one more sensor, motor controller, body, wizard, task,
pane of the page.

A trial is applied to a copy of the packages and has to work there: `tests/daemon/test_trial_changes.py` runs it,
`benchmarks/house.py` prints how many files it changes.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final, NamedTuple

from tests.plugin_kit import files_of

ROOT: Final = Path(__file__).resolve().parents[1]
PACKAGES: Final = ("monstertruckd", "drivers", "planners", "schemas")
DRIVERS: Final = "drivers/monstertruck_drivers"
SCHEMAS: Final = "schemas/monstertruck_schemas"


class Insertion(NamedTuple):
    """Lines put into a file that is there."""

    path: str
    before: str
    """Text before which they are put; it occurs once."""
    text: str


class Trial(NamedTuple):
    """One change."""

    own: Mapping[str, str]
    """New files, all in one place."""
    insertions: tuple[Insertion, ...]
    robot: str
    """A configuration that uses it, YAML."""
    proof: str
    """Python that fails unless it works; ``config`` is the loaded configuration."""

    @property
    def places(self) -> list[str]:
        """Files of the packages that it changes, beside its own."""
        return sorted({insertion.path for insertion in self.insertions})

    def applied(self, folder: Path) -> Path:
        """Make a changed copy of the packages, and the configuration; returns the latter's file."""
        for package in PACKAGES:
            shutil.copytree(ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
        for name, text in self.own.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            assert not path.exists(), f"{name} is not new"
            path.write_text(text, encoding="utf-8")
        for insertion in self.insertions:
            path = folder / insertion.path
            text = path.read_text(encoding="utf-8")
            assert text.count(insertion.before) == 1, f"{insertion.path}: {insertion.before!r}"
            path.write_text(text.replace(insertion.before, insertion.text + insertion.before), encoding="utf-8")
        robot = folder / "robot.yaml"
        robot.write_text(self.robot.replace("configs/", f"{ROOT}/configs/"), encoding="utf-8")
        return robot

    def run(self, folder: Path) -> str:
        """Run the proof in a changed copy.

        Raises:
            AssertionError: it does not work; the text is what was printed.
        """
        code = PRELUDE.format(robot=str(self.applied(folder))) + self.proof
        roots = [folder, *(folder / package for package in PACKAGES[1:]), ROOT]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, roots)), "PYTHONSAFEPATH": "1"}
        ended = subprocess.run(
            [sys.executable, "-c", code], cwd=folder, env=environment, capture_output=True, text=True, check=False
        )
        assert ended.returncode == 0, ended.stdout + ended.stderr
        return ended.stdout


PRELUDE: Final = """
from pathlib import Path

import monstertruckd
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig

assert Path(monstertruckd.__file__).is_relative_to(Path.cwd()), "the changed copy"
config, _ = load_config(Path({robot!r}), SimulatedTruckConfig)
"""

RIG: Final = """
from monstertruck_runtime.clock import run_virtual
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas import topics
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

async def drive(rig, operator, seconds):
    begin = rig.world.truth(rig.clock.now())
    await operator.arm()
    await rig.clock.sleep(seconds)
    end = rig.world.truth(rig.clock.now())
    return ((end.x - begin.x) ** 2 + (end.y - begin.y) ** 2) ** 0.5

config = config.model_copy(update={"recorder": None})
"""
"""For a whole robot on the virtual clock, which follows its path once it is armed."""

DRIVES: Final = f"""
{RIG}
async def main(clock):
    rig = VirtualRig(config, clock)
    async with rig.running():
        await clock.sleep(3.0)
        assert await drive(rig, LocalOperator(rig.daemon, clock), 5.0) > 0.2

run_virtual(main)
"""


def _in_place(package: str, folder: str) -> Callable[[str], str]:
    """Replace the name of a how-to's package by that of its place here."""
    return lambda text: text.replace(f"{package}.", f"{folder}.")


def _sensor() -> Trial:
    """The range finder of the how-to of drivers, as a device of this repository with a role of its own."""
    page = files_of("driver")
    moved = _in_place("truck_sonar", "monstertruck_drivers.mb7360")
    message = page["truck_sonar/message.py"].partition("class SonarRange")[2]
    own = {
        f"{DRIVERS}/mb7360/{name}.py": moved(page[f"truck_sonar/{name}.py"]).replace(
            "monstertruck_drivers.mb7360.message", "monstertruck_schemas.sensor"
        )
        for name in ("__init__", "protocol", "config", "driver", "emulator", "identity")
    }
    plugin = moved(page["truck_sonar/plugin.py"])
    topic = "RANGE: Final = " + plugin.partition("TOPIC = ")[2].partition("\n\n")[0].replace("Writer.", "W.") + "\n"
    role = "RANGER = " + plugin.partition("RANGER = ")[2].partition("\n\n")[0].replace("TOPIC", "topics.RANGE") + "\n"
    kind = plugin.partition("KIND = ")[2].rstrip().replace("baud=BAUD", "baud=9600") + ",\n"
    return Trial(
        own,
        (
            Insertion(f"{SCHEMAS}/sensor.py", "class SonarRanges", f"class SonarRange{message}\n\n"),
            Insertion(f"{SCHEMAS}/topics.py", "    SonarRanges,\n", "    SonarRange,\n"),
            Insertion(f"{SCHEMAS}/topics.py", "IMU: Final = Topic(", topic),
            Insertion(f"{DRIVERS}/catalog.py", "OUR_ROLES: Final = (", role),
            Insertion(f"{DRIVERS}/catalog.py", "    HAND,\n    BATTERY,", "    RANGER,\n"),
            Insertion(f"{DRIVERS}/catalog.py", '    DeviceKind(\n        name="wt61"', f"    {kind}"),
        ),
        page["robot.yaml"] + "\nchecks:\n  ahead: { kind: fresh, topic: sensor/ranger }\n",
        f"""
{RIG}
from monstertruck_schemas.reasons import Reason
from monstertruckd.station.feed import SHOWN

async def main(clock):
    rig = VirtualRig(config, clock)
    with rig.bus.subscribe(topics.RANGE, fifo(64)) as ranges, rig.bus.subscribe(topics.STOP, fifo(8)) as stops:
        async with rig.running():
            await clock.sleep(3.0)
            assert ranges.drain()[-1].frame == "ranger"
            assert await drive(rig, LocalOperator(rig.daemon, clock), 5.0) > 0.2
            assert "ranger" in {{service.name for service in rig.bus.newest(topics.HEALTH).services}}
            rig.robot.emulators["ranger"].inject("garbage", "on")
            await clock.sleep(1.5)
            assert "ahead: sensor/ranger is silent" in {{cause.text for stop in stops.drain() for cause in stop.causes}}

run_virtual(main)
assert topics.BY_NAME["sensor/ranger"].logged
assert topics.HEALTH in {{shown.topic for shown in SHOWN}}, "the page shows every service"
""",
    )


def _motor_controller() -> Trial:
    """A relative of the EPOS with a line of its own."""
    settings = '''"""Settings of the twin."""

from typing import Literal

from monstertruck_drivers.epos.config import EposConfig


class TwinConfig(EposConfig):
    """A controller that speaks as an EPOS does."""

    kind: Literal["twin"] = "twin"  # type: ignore[assignment]
'''
    row = """    DeviceKind(
        name="twin",
        doc="A controller that speaks as an EPOS does",
        roles=(DRIVE, DRIVE_2, DRIVE_3, DRIVE_4),
        settings="monstertruck_drivers.twin.config:TwinConfig",
        implementation="monstertruck_drivers.epos.driver:EposDriver",
        emulator="monstertruck_drivers.epos.emulator:emulated",
        identity="monstertruck_drivers.epos.identity:identify",
        baud=EPOS_BAUD,
    ),
"""
    return Trial(
        {f"{DRIVERS}/twin/__init__.py": '"""The twin."""\n', f"{DRIVERS}/twin/config.py": settings},
        (Insertion(f"{DRIVERS}/catalog.py", '    DeviceKind(\n        name="steppers"', row),),
        "include: configs/demo.yaml\nversion: 2\ndevices:\n  drive:\n    driver: { kind: twin }\n",
        DRIVES,
    )


def _body() -> Trial:
    """The tracked vehicle of the how-to of bodies, as a body of this repository."""
    page = files_of("robot_body")
    settings = page["truck_tracked/config.py"].partition("class TrackedBody")[2]
    row = page["truck_tracked/plugin.py"].partition("TRACKED = ")[2].rstrip()
    row = row.replace("truck_tracked.config", "monstertruck_schemas.body")
    row = row.replace("truck_tracked.chassis", "monstertruck_kinematics.tracked")
    return Trial(
        {"planners/monstertruck_kinematics/tracked.py": page["truck_tracked/chassis.py"]},
        (
            Insertion(f"{SCHEMAS}/body.py", "class SynchroBody", f"class TrackedBody{settings}\n\n"),
            Insertion("schemas/monstertruck_runtime/bodies.py", '    Plugin(\n        name="synchro"', f"    {row},\n"),
        ),
        page["robot.yaml"],
        DRIVES,
    )


def _wizard() -> Trial:
    """A wizard that measures the bias of the yaw rate at rest."""
    procedure = '''"""Bias of the yaw rate at rest."""

from dataclasses import dataclass
from typing import ClassVar

from monstertruck_schemas import topics
from monstertruckd.config.calibration import Result, WizardName
from monstertruckd.tools.calibrate.statistics import Interval, estimated
from monstertruckd.tools.calibrate.steps import Collect
from monstertruckd.tools.calibrate.wizard import WizardContext


@dataclass(frozen=True, slots=True)
class BiasWizard:
    """Listens to the unit at rest."""

    name: ClassVar[WizardName] = "bias"
    doc: ClassVar[str] = "bias of the yaw rate at rest"
    room: ClassVar[str] = ""
    readings: int = 50

    async def __call__(self, context: WizardContext) -> Result:
        """Measure."""
        found = await context.collect(Collect("the unit at rest", topics.IMU, self.readings, 60.0))
        mean = sum(reading.angular_velocity.z for reading in found) / len(found)
        estimate = estimated("rate_z", Interval(mean, 0.001), "rad/s", len(found), "bias of the yaw rate")
        return Result(wizard="bias", measured="at rest", estimates=(estimate,))
'''
    row = """    WizardKind(
        name="bias",
        doc="Bias of the yaw rate at rest.",
        procedure="monstertruckd.tools.calibrate.bias:BiasWizard",
        keys=(f"{IMU}.rate_z",),
        lifetime=Lifetime(90, None, "imu", MOTION),
        goals={"rate_z": Goal(0.002)},
        steps=(SequenceStep("rate_z"),),
        fits=_truck_with("imu"),
        options=(WizardOption("readings", 50, "Readings at rest.", 10, 1000),),
    ),
"""
    return Trial(
        {"monstertruckd/tools/calibrate/bias.py": procedure},
        (Insertion("monstertruckd/config/wizards.py", '    WizardKind(\n        name="slip"', row),),
        "include: configs/demo.yaml\nversion: 2\n",
        """
import asyncio
from types import SimpleNamespace

from typer.testing import CliRunner

from monstertruckd.config.calibration import may_set
from monstertruckd.config.wizards import WIZARDS, sequence
from monstertruckd.tools.cli.main import app

shown = CliRunner().invoke(app, ["calibrate", "bias", "--help"], env={"COLUMNS": "200"}).output
assert "--readings" in shown, shown

class Context:
    async def collect(self, step):
        return [SimpleNamespace(angular_velocity=SimpleNamespace(z=0.01))] * step.count

result = asyncio.run(WIZARDS["bias"].make(readings=20)(Context()))
(estimate,) = result.estimates
assert (round(estimate.value, 3), estimate.samples) == (0.01, 20)
assert may_set("bias", "devices.imu.driver.correction.rate_z")
assert "bias" in {run.name for run in sequence()}
""",
    )


def _task() -> Trial:
    """A behaviour that drives ahead for some time: a task of its own."""
    behaviour = '''"""Drives straight ahead for some seconds."""

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from monstertruck_planners.behave.api import BehaviourConfig, BehaviourStep, Inputs, RequestedMotion
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.topics import Topic


class AheadConfig(BehaviourConfig):
    """Straight ahead."""

    kind: Literal["ahead"]
    seconds: Annotated[float, Field(gt=0, le=10)] = 2.0


class Ahead:
    """Drives straight ahead."""

    reads: ClassVar[tuple[Topic[Any], ...]] = ()

    def __init__(self, config: AheadConfig) -> None:
        self._config = config

    def begin(self) -> None:
        """Return the state before the first step."""

    def step(self, inputs: Inputs, state: Any, t: float) -> BehaviourStep:
        """Drive on until the time is over."""
        if t > self._config.seconds:
            return BehaviourStep(None, state, "ahead", Reason.GOAL_REACHED)
        return BehaviourStep(RequestedMotion(0.1), state, "ahead")
'''
    row = """    Plugin(
        name="ahead",
        settings="monstertruck_planners.behave.ahead:AheadConfig",
        implementation="monstertruck_planners.behave.ahead:Ahead",
        doc="Drives straight ahead for some seconds",
    ),
"""
    return Trial(
        {"planners/monstertruck_planners/behave/ahead.py": behaviour},
        (Insertion("planners/monstertruck_planners/behave/catalog.py", '    Plugin(\n        name="move"', row),),
        "include: configs/demo.yaml\nversion: 2\ntracker: null\npath: null\nbehaviours:\n  ahead: { kind: ahead }\n",
        f"""
{RIG}
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import BehaviourOrder

async def main(clock):
    rig = VirtualRig(config, clock)
    with rig.bus.subscribe(topics.BEHAVIOUR, fifo(4096)) as states:
        async with rig.running():
            await clock.sleep(3.0)
            operator = LocalOperator(rig.daemon, clock)
            await operator.arm()
            order = {{**await operator.header(), "order": BehaviourOrder.START, "behaviour": "ahead"}}
            assert await operator.call("behave", order) == {{"number": 1}}
            await clock.sleep(4.0)
            end = states.drain()[-1]
            assert (end.outcome, end.phase) == (Reason.GOAL_REACHED, "ahead"), end
            assert end.travelled > 0.1

run_virtual(main)
""",
    )


MEMORY_PANE: Final = """// How much memory the robot's computer has left.
import { element } from "./dom.js";
import { addPane } from "./panes.js";
import { number, words } from "./words.js";

export class Memory {
  /** @param {import("./socket.js").Link} link */
  constructor(link) {
    const free = element("p");
    addPane("memory", free);
    link.on("host", (host) => {
      free.textContent = words("memory.free", { gigabytes: number(host.memory_available / 1e9, 1) });
    });
  }
}
"""

SHOWN: Final = """
import asyncio
from pathlib import Path

from monstertruckd.station.server import PAGE, TYPES, _strings
from tests.daemon.browser_kit import CHROMIUM, chromium, new_tab

async def serve(route, request):
    name = request.url.rpartition("/")[2] or "index.html"
    if name == "strings.json":
        await route.fulfill(body=_strings(), content_type="application/json")
    else:
        await route.fulfill(body=(PAGE / name).read_bytes(), content_type=TYPES[Path(name).suffix])

async def main():
    async with chromium(Path.cwd()) as browser:
        page = await new_tab(browser)
        await page.route("http://page/**", serve)
        await page.goto("http://page/")
        await page.click("text=Memory")
        assert await page.is_visible("#pane-memory")
        assert not await page.is_visible("#pane-drive")

assert (PAGE / "memory.js").is_file()
if CHROMIUM is not None:
    asyncio.run(main())
"""
"""The page alone, in a browser if there is one."""


def _page_panel() -> Trial:
    """A pane of the station's page, of a message that it gets already."""
    page = "monstertruckd/station/page"
    insertions = (
        Insertion(
            f"{page}/main.js",
            'import { MissionTool } from "./mission.js";\n',
            'import { Memory } from "./memory.js";\n',
        ),
        Insertion(f"{page}/main.js", "new Guide();\n", "new Memory(link);\n"),
        Insertion(
            f"{page}/strings/en.json",
            '  "tab.tryout": "Try",\n',
            '  "tab.memory": "Memory",\n  "memory.free": "{gigabytes} GB free",\n',
        ),
    )
    return Trial({f"{page}/memory.js": MEMORY_PANE}, insertions, "include: configs/demo.yaml\n", SHOWN)


TRIALS: Final[Mapping[str, Callable[[], Trial]]] = {
    "sensor_role": _sensor,
    "motor_controller": _motor_controller,
    "body": _body,
    "wizard": _wizard,
    "task": _task,
    "page_panel": _page_panel,
}
"""By the kind of change."""
