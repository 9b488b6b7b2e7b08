"""The installed service in a Debian that boots, judged by its systemd and the emulated truck's wire.

    python benchmarks/service.py [--keep FOLDER]

Needs root, Debian's packages and the package index: mmdebstrap makes a minimal Debian, `bootstrap` the program's
environment inside it, systemd-nspawn boots it (both programs are installed if missing). The service is installed,
driven, frozen, killed, upgraded, booted again and removed. Takes ten minutes.
"""

import argparse
import json
import subprocess
import sys
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic
from typing import Any, TypeVar

from mcap.reader import make_reader

from benchmarks import ROOT
from benchmarks.service_parts.machine import Machine, NotBootedError, Output, install_tools, until
from monstertruck_drivers.epos import objects as od
from monstertruck_drivers.epos.protocol import Control
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.reasons import Reason
from monstertruckd.bootstrap import find_uv
from monstertruckd.host.logging_queue import PRIORITIES
from monstertruckd.tools.drill.observer import STANDING_SPEED, written

PARTS = Path(__file__).resolve().parent / "service_parts"
SERVICE = "monstertruckd.service"
PROGRAM, NEXT, NEVER = (Path("/opt") / name for name in ("monstertruckd", "next", "never"))
"""What is installed first, another version, and one whose gate never ticks."""
TRUCK = """
include: parts/chassis.yaml
version: 2
devices:
  lidar: { port: { path: /dev/truck/lidar } }
  drive: { port: { path: /dev/truck/drive } }
  steering: { port: { path: /dev/truck/steering } }
  compass: { port: { path: /dev/truck/compass } }
path: { file: paths/loop.csv, closed: true }
tracker: { kind: pure_pursuit }
odometry: { start: { x: 0.0, y: -1.7, yaw: 0.0 } }
"""
EMULATED_UNIT = """
[Service]
ExecStart={folder}/.venv/bin/python -P {folder}/benchmarks/service_parts/emulated.py \\
  {folder}/configs/truck-of-the-benchmark.yaml /var/lib/wire.jsonl
[Install]
WantedBy=multi-user.target
"""
SPEED = 0.1
"""True speed from which the truck counts as driving, m/s."""
OFF_GOALS = {"killed": 2.0, "process_frozen": 5.5, "loop_frozen": 5.5, "gate_frozen": 5.5, "stopped": 1.5}
"""Seconds until the drive's controller has been commanded to switch off, which the stop script does last."""
STAND_GOALS = OFF_GOALS | {"gate_frozen": 1.0}
"""Seconds until the truck stands; without a gate the drive's own driver stops it."""
READY_GOAL = 20.0
"""Seconds from a death, or from systemd's start, to the next READY."""
LEVELS = {name: PRIORITIES[level] for name, level in (("INFO", 20), ("WARNING", 30), ("ERROR", 40))}


class WireLog:
    """Reads the emulated truck's growing log."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._offset = 0
        self._rows: list[dict[str, Any]] = []

    def since(self, instant: float) -> "Wire":
        """Return the entries from an instant on, s of CLOCK_MONOTONIC."""
        with self._file.open("rb") as stream:
            stream.seek(self._offset)
            whole = stream.read().rpartition(b"\n")[0]
        if whole:
            self._offset += len(whole) + 1
            self._rows += map(json.loads, whole.splitlines())
        rows = self._rows[bisect_left(self._rows, instant, key=lambda row: row["t"]) :]
        return Wire(
            [(round(row["t"] * SECOND), bytes.fromhex(row["hex"])) for row in rows if row.get("to_device")],
            [(row["t"], row["v"]) for row in rows if "v" in row],
        )


@dataclass(frozen=True)
class Wire:
    """Traffic on the wire of the drive, and the true speed."""

    to_device: list[tuple[int, bytes]]
    """(ns, bytes)"""
    speeds: list[tuple[float, float]]
    """(s, m/s)"""

    def reported(self, control: Control) -> float | None:
        """Return the time of the first such control word, s."""
        words = (at for at, index, value in written(self) if (index, value) == (od.CONTROLWORD.index, control))
        return next((at / SECOND for at in words), None)

    def stood(self) -> float | None:
        """Return the time of standstill, s."""
        return next((at for at, speed in self.speeds if abs(speed) < STANDING_SPEED), None)

    def metres(self, end: float) -> float:
        """Return the distance travelled until then, m."""
        times = [at for at, _ in self.speeds]
        steps = zip(self.speeds, times[1:], strict=False)
        return sum(abs(v) * (following - at) for (at, v), following in steps if at < end)


class Bench:
    """The machine, the wire, and the results."""

    command = f"{PROGRAM}/.venv/bin/monstertruckd"
    """The installed program, inside the machine."""

    def __init__(self, machine: Machine) -> None:
        self.machine = machine
        self.wire = WireLog(machine.root / "var/lib/wire.jsonl")
        self.figures: dict[str, Any] = {}
        self.goals: dict[str, Any] = {}
        self.missed: list[str] = []

    def holds(self, name: str, fact: bool, text: object = "") -> None:
        """Record a required fact."""
        self._judge(name, fact, True, fact, text)

    def within(self, name: str, value: float | None, goal: float) -> None:
        """Record a duration and its limit, s."""
        figure = None if value is None else round(value, 2)
        self._judge(name, figure, goal, value is not None and value <= goal)

    def _judge(self, name: str, figure: Any, goal: Any, met: bool, text: object = "") -> None:
        self.figures[name], self.goals[name] = figure, goal
        if not met:
            self.missed.append(name)
        print(f"{'ok  ' if met else 'MISS'} {name}: {figure} (goal {goal}) {'' if met else text}", flush=True)

    def program(self, *arguments: str, folder: Path = PROGRAM) -> Output:
        """Run the command line of an installed version."""
        return self.machine.run(f"{folder}/.venv/bin/monstertruckd", *arguments, check=False)

    def show(self, *names: str) -> dict[str, str]:
        """Return properties of the service from systemd."""
        return self.machine.show(SERVICE, *names)

    def active(self) -> bool:
        """Whether systemd has received READY."""
        return self.show("ActiveState")["ActiveState"] == "active"

    def exec_start(self) -> str:
        """Return the command of the unit."""
        return self.show("ExecStart")["ExecStart"]

    def drive(self) -> bool:
        """Start the lap and drive; return whether it drives."""
        self.machine.run("systemctl", "stop", SERVICE)
        self.machine.run("systemctl", "restart", "emulated.service")
        if not until(lambda: self.machine.run("test", "-e", "/dev/truck/compass", check=False).returncode == 0, 30):
            return False
        self.machine.run("systemctl", "start", SERVICE)
        until(lambda: self.program("arm").returncode == 0, 20, every=0.5)
        # To the daemon the ports are real: arming alone does not start the path.
        self.machine.run("systemd-run", "--quiet", self.command, "path", "loop", "--arm")
        return until(self.moves, 20)

    def moves(self) -> bool:
        """Whether the truck truly drives."""
        speeds = self.wire.since(monotonic() - 0.5).speeds
        return bool(speeds) and abs(speeds[-1][1]) > SPEED

    def journal(self, since: float) -> list[dict[str, Any]]:
        """Return the entries of the service, and of systemd about it, from an instant on, s of CLOCK_MONOTONIC."""
        lines = self.machine.run("journalctl", f"--unit={SERVICE}", "--output=json", "--boot", "--all").stdout
        entries = [json.loads(line) for line in lines.splitlines()]
        return [entry for entry in entries if int(entry["__MONOTONIC_TIMESTAMP"]) >= since * 1e6]

    def dies(self, name: str, action: Callable[[], object], *, says: tuple[str, ...], restarts: bool = True) -> None:
        """End the daemon of a driving truck; check the stop on the wire, the cause in the journal, and the restart."""
        if not self.drive():
            self.holds(f"{name}_drives", fact=False, text=self.machine.run("systemctl", "status", SERVICE, check=False))
            return
        before = self.show("MainPID")["MainPID"]
        began = monotonic()
        action()
        if restarts:
            until(lambda: self.active() and self.show("MainPID")["MainPID"] != before, 60)
            started = int(self.show("ActiveEnterTimestampMonotonic")["ActiveEnterTimestampMonotonic"]) / 1e6
            self.within(f"{name}_ready_again_s", started - began if self.active() else None, READY_GOAL)
        until(lambda: self.wire.since(began).stood() is not None, 10)
        wire = self.wire.since(began)
        off, stood = wire.reported(Control.DISABLE_VOLTAGE), wire.stood()
        self.holds(f"{name}_quick_stop", wire.reported(Control.QUICK_STOP) is not None)
        self.within(f"{name}_power_off_s", None if off is None else off - began, OFF_GOALS[name])
        self.within(f"{name}_stands_s", None if stood is None else stood - began, STAND_GOALS[name])
        self.figures[f"{name}_metres"] = round(wire.metres(stood or monotonic()), 2)
        reported = [str(entry.get("MESSAGE")) for entry in self.journal(began)]
        for words in says:
            self.holds(f"{name}_journal: {words}", any(words in line for line in reported), "\n".join(reported[-40:]))


AnyBench = TypeVar("AnyBench", bound=Bench)

# What is tried, in this order


def install(bench: Bench) -> None:
    machine = bench.machine
    began = monotonic()
    config = str(PROGRAM / "configs/truck-of-the-benchmark.yaml")
    done = bench.program("install-service", "--config", config, "--start")
    bench.holds("install_ended_well", done.returncode == 0, done.stdout + done.stderr)
    bench.within("install_to_ready_s", monotonic() - began, 40.0)
    bench.holds("active", bench.active())
    bench.holds("enabled", machine.run("systemctl", "is-enabled", SERVICE, check=False).stdout.strip() == "enabled")
    groups = machine.run("id", "-nG", "monstertruckd", check=False).stdout.split()
    bench.holds("user_in_groups", {"dialout", "video"} <= set(groups), groups)
    again = bench.program("install-service")
    bench.holds("second_run_changes_nothing", "nothing to change" in again.stdout, again.stdout + again.stderr)
    bench.holds("ready_by_notify", "disarmed" in bench.show("StatusText")["StatusText"])
    sandbox(bench)


def sandbox(bench: Bench) -> None:
    """Check the running daemon's restrictions in the kernel."""
    pid = bench.show("MainPID")["MainPID"]
    status = bench.machine.run("cat", f"/proc/{pid}/status").stdout
    facts = dict(line.split(":\t", 1) for line in status.splitlines() if ":\t" in line)
    bench.holds("no_capabilities", all(int(facts[name], 16) == 0 for name in ("CapEff", "CapBnd", "CapAmb")))
    bench.holds("no_new_privileges", facts["NoNewPrivs"] == "1")
    bench.holds("system_calls_filtered", facts["Seccomp"] == "2")
    bench.holds("not_root", not facts["Uid"].startswith("0\t"))
    inside = ("nsenter", f"--target={pid}", "--mount", "--setuid=0", "--", "sh", "-c")
    for name, command in (
        ("system_read_only", "! touch /usr/x /etc/x"),
        ("homes_hidden", 'test -z "$(ls -A /root)$(ls -A /home)"'),
        ("state_writable", "touch /var/lib/monstertruckd/x && rm /var/lib/monstertruckd/x"),
    ):
        done = bench.machine.run(*inside, command, check=False)
        bench.holds(name, done.returncode == 0, done.stdout + done.stderr)


def ready_after_tick(bench: Bench) -> None:
    """Check in the daemon's log that the gate's first state is older than systemd's READY."""
    started = int(bench.show("ActiveEnterTimestampMonotonic")["ActiveEnterTimestampMonotonic"]) * 1000
    forked = int(bench.show("ExecMainStartTimestampMonotonic")["ExecMainStartTimestampMonotonic"]) * 1000
    bench.machine.run("systemctl", "stop", SERVICE)
    logs = sorted(
        (bench.machine.root / "var/lib/monstertruckd/logs").glob("*.mcap"), key=lambda log: log.stat().st_mtime
    )
    with logs[-1].open("rb") as stream:
        stamps = [
            at
            for _, channel, message in make_reader(stream).iter_messages()
            if channel.topic.endswith("state/gate")
            for at in [message.publish_time]
        ]
    bench.figures["first_tick_s"] = round((stamps[0] - forked) / SECOND, 2)
    bench.figures["ready_s"] = round((started - forked) / SECOND, 2)
    bench.holds("ready_after_first_tick", forked < stamps[0] <= started, (forked, stamps[0], started))


def deaths(bench: Bench) -> None:
    def send(name: str) -> Callable[[], object]:
        return lambda: bench.machine.run("systemctl", "kill", f"--signal={name}", "--kill-whom=main", SERVICE)

    hung = ("Watchdog timeout", "Failed with result 'watchdog'")
    dumped = ("Fatal Python error: Aborted",)
    began = monotonic()
    bench.dies("killed", send("SIGKILL"), says=("Failed with result 'signal'", "neutral: /dev/truck/drive: stopped"))
    bench.dies("process_frozen", send("SIGSTOP"), says=(*hung, "neutral: /dev/truck/drive: stopped"))
    bench.dies("loop_frozen", send("SIGUSR1"), says=(*hung, *dumped, "neutral: /dev/truck/drive: stopped"))
    bench.dies("gate_frozen", send("SIGUSR2"), says=(*hung, *dumped, "no control tick for"))
    stop = lambda: bench.machine.run("systemctl", "stop", SERVICE)  # noqa: E731
    bench.dies("stopped", stop, says=("Deactivated successfully",), restarts=False)
    bench.holds("stays_stopped", bench.show("ActiveState")["ActiveState"] == "inactive")
    priorities(bench, began)


def priorities(bench: Bench, since: float) -> None:
    """Check that every line of the daemon's log has the priority of its level."""
    seen: dict[str, set[str]] = {}
    for entry in bench.journal(since):
        level = str(entry.get("MESSAGE", "")).split(" ")[0]
        if level in LEVELS and entry.get("_TRANSPORT") == "stdout":
            seen.setdefault(level, set()).add(entry["PRIORITY"])
    wanted = {level: {str(priority)} for level, priority in LEVELS.items()}
    bench.figures["journal_priorities"] = {level: sorted(found) for level, found in seen.items()}
    bench.holds("journal_priorities_right", seen == wanted, seen)


def upgrades(bench: Bench) -> None:
    bench.holds("drives_before_upgrade", bench.drive())
    pid = bench.show("MainPID")["MainPID"]
    refused = bench.program("install-service", "--upgrade", folder=NEXT)
    bench.holds("upgrade_refused_while_armed", refused.returncode == Reason.BUSY.exit_code, refused)
    bench.holds("drives_on_when_refused", bench.show("MainPID")["MainPID"] == pid and bench.moves())
    bench.holds("nothing_replaced_when_refused", f"{PROGRAM}/" in bench.exec_start())
    bench.program("disarm")
    until(lambda: "disarmed" in bench.show("StatusText")["StatusText"], 10)
    began = monotonic()
    done = bench.program("install-service", "--upgrade", folder=NEXT)
    bench.holds("upgraded", done.returncode == 0 and f"{NEXT}/" in bench.exec_start() and bench.active(), done)
    bench.within("upgrade_s", monotonic() - began, 30.0)
    for name, change in (("never_ready", never_ticks), ("dies_at_start", dies)):
        change(bench.machine.root)
        began = monotonic()
        done = bench.program("install-service", "--upgrade", folder=NEVER)
        bench.holds(f"{name}_fails", done.returncode == Reason.COMMAND_FAILED.exit_code, done)
        back = f"{NEXT}/" in bench.exec_start() and bench.active()
        bench.holds(f"{name}_back_to_the_version_before", back and "the version before runs again" in done.stderr, done)
        bench.within(f"{name}_s", monotonic() - began, 100.0)


def never_ticks(root: Path) -> None:
    """Make the third version one whose gate never ticks."""
    _edit(
        root,
        "monstertruckd/gate/service.py",
        "        while True:\n            due =",
        "        while await asyncio.Event().wait():\n            due =",
    )


def dies(root: Path) -> None:
    """Make the third version one that ends at once."""
    _edit(root, "monstertruckd/run.py", "    faulthandler.enable()", "    raise SystemExit(1)")


def _edit(root: Path, name: str, before: str, after: str) -> None:
    file = root / NEVER.relative_to("/") / name
    text = file.read_text(encoding="utf-8")
    assert text.count(before) == 1, f"{name} has changed: {before!r}"
    file.write_text(text.replace(before, after), encoding="utf-8")


def second_boot(bench: Bench) -> None:
    """Check that the truck stays at rest after a power-on."""
    bench.holds("active_after_boot", until(bench.active, 60))
    stamps = bench.machine.show("", "UserspaceTimestampMonotonic") | bench.show("ActiveEnterTimestampMonotonic")
    began, ready = (int(stamps[f"{name}TimestampMonotonic"]) / 1e6 for name in ("Userspace", "ActiveEnter"))
    bench.within("boot_to_ready_s", ready - began, READY_GOAL)
    bench.holds("drives_after_boot", bench.drive())


def uninstall(bench: Bench) -> None:
    began = monotonic()
    done = bench.program("uninstall-service", folder=NEXT)
    bench.holds("uninstalled", done.returncode == 0, done)
    until(lambda: bench.wire.since(began).stood() is not None, 10)
    wire = bench.wire.since(began)
    off = wire.reported(Control.DISABLE_VOLTAGE)
    bench.within("uninstall_power_off_s", None if off is None else off - began, OFF_GOALS["stopped"] + 2)
    bench.holds("unit_gone", bench.show("LoadState")["LoadState"] == "not-found")
    root = bench.machine.root
    left = [
        file
        for folder in ("etc/systemd", "etc/udev", "etc/sysusers.d", "etc/tmpfiles.d", "etc/modules-load.d")
        for file in (root / folder).rglob("*monstertruckd*")
    ]
    bench.holds("files_gone", not left, left)
    kept = [root / "etc/monstertruckd", root / "var/lib/monstertruckd/logs"]
    bench.holds("configuration_and_logs_stay", all(folder.is_dir() for folder in kept))


# The machine


def versions(machine: Machine) -> None:
    """Copy this tree into the machine, three times, each with its environment."""
    for folder in (PROGRAM, NEXT, NEVER):
        checkout(machine, folder)
    place = machine.root / PROGRAM.relative_to("/")
    freezable(place / ".venv")
    emulated_truck(machine, PROGRAM)


def checkout(machine: Machine, folder: Path) -> None:
    """Copy this tree into a folder of the machine, with its environment."""
    caches = {
        Path.home() / ".cache" / "uv": "/root/.cache/uv",
        Path(find_uv()).parent: "/root/.cache/monstertruckd",
    }
    place = machine.root / folder.relative_to("/")
    copy_tree(place)
    if not (place / ".venv").exists():
        sync = "from monstertruckd.bootstrap import sync; sync(('robot', 'sim'))"
        machine.prepare(folder, ["python3", "-c", sync], caches)


def copy_tree(place: Path) -> None:
    """Copy the files of this tree known to git, including uncommitted changes."""
    place.mkdir(parents=True, exist_ok=True)
    listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(listed, cwd=ROOT, capture_output=True, check=True).stdout
    pack = ["tar", "--create", "--null", "--files-from=-"]
    archive = subprocess.run(pack, cwd=ROOT, input=names, capture_output=True, check=True).stdout
    subprocess.run(["tar", "--extract", "--no-same-owner"], cwd=place, input=archive, check=True)


def freezable(environment: Path) -> None:
    """Let signals freeze the programs of an environment."""
    (packages,) = environment.glob("lib/python3.*/site-packages")
    (packages / "freezing.py").write_text((PARTS / "freezing.py").read_text())
    (packages / "freezing.pth").write_text("import freezing\n")


def emulated_truck(machine: Machine, folder: Path) -> None:
    """Start the truck behind /dev/truck together with the machine, by the checkout in one of its folders."""
    place = machine.root / folder.relative_to("/")
    (place / "configs/truck-of-the-benchmark.yaml").write_text(TRUCK)
    unit = machine.root / "etc/systemd/system/emulated.service"
    unit.write_text(EMULATED_UNIT.format(folder=folder))
    (unit.parent / "multi-user.target.wants").mkdir(exist_ok=True)
    enabled = unit.parent / "multi-user.target.wants" / unit.name
    enabled.unlink(missing_ok=True)
    enabled.symlink_to(f"/etc/systemd/system/{unit.name}")


def run(bench: Bench) -> None:
    """Run all stages.

    Raises:
        NotBootedError: the machine did not boot; the text is the cause.
    """
    install_tools()
    began = monotonic()
    if not bench.machine.root.exists():
        bench.machine.build()
    versions(bench.machine)
    bench.figures["build_s"] = round(monotonic() - began, 1)
    for stages in ((install, ready_after_tick, deaths, upgrades), (second_boot, uninstall)):
        began = monotonic()
        with bench.machine.booted():
            bench.figures.setdefault("boot_s", round(monotonic() - began, 1))
            for stage in stages:
                print(f"== {stage.__name__}", flush=True)
                stage(bench)


def judged(name: str, kind: type[AnyBench], keep: Path | None, run: Callable[[AnyBench, Path], None]) -> int:
    """Run a benchmark of the machine, print and write its result; return 0 if all goals are met.

    Args:
        name: name of the benchmark.
        kind: class of its bench.
        keep: folder that keeps the machine; None: it is removed.
        run: runs all of it, with a scratch folder; may raise ``NotBootedError``.
    """
    with TemporaryDirectory(prefix=f"{name}-", dir="/var/tmp") as scratch:
        folder = keep or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        bench = kind(Machine(folder / "root", folder / "console.log"))
        stopped_by = None
        try:
            run(bench, Path(scratch))
        except NotBootedError as error:
            stopped_by = str(error)
            print(f"stopped: {error}", file=sys.stderr)
    met = stopped_by is None and not bench.missed
    result = {"bench": name, "figures": bench.figures, "goals": bench.goals, "missed": bench.missed, "met": met}
    if stopped_by is not None:
        result["stopped_by"] = stopped_by
    output = ROOT / "runs" / "benchmarks" / f"{name}.json"
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text(json.dumps(result, indent=1), encoding="utf-8")
    print(json.dumps(result))
    return 0 if met else 1


def main() -> int:
    """Run all stages; 0: all goals are met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keep", type=Path, help="leave what is built in this folder, and use what is there already")
    return judged("service", Bench, parser.parse_args().keep, lambda bench, _: run(bench))


if __name__ == "__main__":
    sys.exit(main())
