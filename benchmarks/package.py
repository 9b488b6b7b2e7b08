"""The packages: a wheel for every Python, and a Debian package in a Debian that boots.

    python benchmarks/package.py [--only wheels debian] [--keep FOLDER]

``wheels`` builds source archive and wheel, checks both (twine, check-wheel-contents) and installs the wheel, from an
empty folder, into environments of every Python that is here, with the lowest and the highest allowed versions of its
dependencies: the program starts, and drives the demo with the extras that this needs. ``debian`` needs root and
Debian's packages: three versions of the package, one of which dies at its start, are installed, driven, killed, frozen,
upgraded, rolled back, booted again and purged. Ten minutes each.
"""

import argparse
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from time import monotonic

from benchmarks import ROOT
from benchmarks.service import READY_GOAL, Bench, checkout, copy_tree, deaths, emulated_truck, freezable, judged
from benchmarks.service_parts.machine import Machine, Output, install_tools, until
from monstertruckd import __version__
from monstertruckd.bootstrap import EXTRAS, find_uv

PYTHONS = ("3.11", "3.12", "3.13", "3.14")
CHECKERS = ("twine", "check-wheel-contents")
EMULATED = Path("/opt/emulated")
"""Checkout inside the machine that emulates the truck's devices."""
NEXT, BROKEN = f"{__version__}+1", f"{__version__}+2"


class Packages(Bench):
    """Results, and the machine of the Debian packages."""

    command = "/usr/bin/monstertruckd"

    def __init__(self, machine: Machine) -> None:
        super().__init__(machine)
        self.debs: dict[str, str] = {}
        """Packages inside the machine, by version."""

    def runs(self, version: str) -> bool:
        """Whether the service runs a version."""
        return self.active() and f"/opt/monstertruckd/{version}/" in self.exec_start()

    def folders(self) -> set[str]:
        """Return the installed versions."""
        return {place.name for place in (self.machine.root / "opt/monstertruckd").iterdir()}

    def dpkg(self, version: str) -> Output:
        """Install the package of a version."""
        return self.machine.run("dpkg", "--install", self.debs[version], check=False)

    def program(self, *arguments: str, folder: Path = Path()) -> Output:
        """Run the program installed by the package."""
        return self.machine.run(self.command, *arguments, check=False)


# Wheels


def wheels(bench: Packages, scratch: Path) -> None:
    """Build, check and install the archives."""
    uv, dist = find_uv(), scratch / "dist"
    done = tried(uv, "build", "--quiet", "--system-certs", "--out-dir", dist)
    bench.holds("archives_built", done.returncode == 0, done.stderr)
    files = sorted(map(str, dist.glob("monstertruckd-*")))
    tools = scratch / "tools"
    tried(uv, "venv", "--quiet", "--python", sys.executable, tools)
    tried(uv, "pip", "install", "--quiet", "--system-certs", "--python", tools / "bin/python", *CHECKERS)
    wheel = next(file for file in files if file.endswith(".whl"))
    for name, command in (
        ("twine", ("twine", "check", "--strict", *files)),
        ("wheel_contents", ("check-wheel-contents", wheel)),
    ):
        done = tried(tools / "bin" / command[0], *command[1:])
        bench.holds(name, done.returncode == 0, done.stdout + done.stderr)
    for python in pythons(uv):
        for resolution in ("highest", "lowest-direct"):
            environment(bench, uv, wheel, python, resolution, scratch)


def pythons(uv: str) -> Iterator[str]:
    """Yield the paths of the supported Pythons on this computer, and print the missing ones."""
    for version in PYTHONS:
        done = tried(uv, "python", "find", "--no-python-downloads", "--system", version)
        if done.returncode == 0:
            yield done.stdout.strip()
        else:
            print(f"not here: Python {version}", flush=True)


def environment(bench: Packages, uv: str, wheel: str, python: str, resolution: str, scratch: Path) -> None:
    """Install the wheel alone, then what the demo needs, and run both."""
    version = tried(python, "-c", "import sys; print('%d.%d' % sys.version_info[:2])").stdout.strip()
    name, place = f"python{version}_{resolution.partition('-')[0]}", scratch / f"{version}-{resolution}"
    tried(uv, "venv", "--quiet", "--python", python, place)
    install = (uv, "pip", "install", "--quiet", "--system-certs", "--python", place / "bin/python")
    done = tried(*install, "--resolution", resolution, wheel)
    bench.holds(f"{name}_installs", done.returncode == 0, done.stderr)
    program = place / "bin/monstertruckd"
    done = tried(program, "--help", cwd=place)
    bench.holds(f"{name}_help", done.returncode == 0, done.stderr)
    done = tried(*install, "--resolution", resolution, f"{wheel}[{','.join(EXTRAS['demo'])}]")
    bench.holds(f"{name}_demo_installs", done.returncode == 0, done.stderr)
    done = tried(program, "demo", "--fast", cwd=place)
    bench.holds(f"{name}_demo", done.returncode == 0, done.stdout[-500:] + done.stderr[-1500:])
    shutil.rmtree(place)


def tried(*command: str | Path, cwd: Path = ROOT) -> Output:
    """Run a program of this computer to its end."""
    quiet = {name: value for name, value in os.environ.items() if name != "VIRTUAL_ENV"}
    return subprocess.run(
        [str(word) for word in command], cwd=cwd, env=quiet, capture_output=True, text=True, check=False
    )


# The Debian package


def debian(bench: Packages, scratch: Path) -> None:
    """Test the life of a package on a robot."""
    install_tools()
    if not bench.machine.root.exists():
        bench.machine.build()
    checkout(bench.machine, EMULATED)
    emulated_truck(bench.machine, EMULATED)
    bench.debs = {version: deb(bench, version, scratch) for version in (__version__, NEXT, BROKEN)}
    for stages in ((install, deaths, upgrades), (second_boot, removal)):
        with bench.machine.booted():
            for stage in stages:
                print(f"== {stage.__name__}", flush=True)
                stage(bench)


def deb(bench: Packages, version: str, scratch: Path) -> str:
    """Build one version from a copy of this checkout; return its path inside the machine."""
    tree = scratch / f"tree-{version}"
    copy_tree(tree)
    replaced(tree / "monstertruckd/__init__.py", f'__version__ = "{__version__}"', f'__version__ = "{version}"')
    if version == BROKEN:
        replaced(tree / "monstertruckd/run.py", "    faulthandler.enable()", "    raise SystemExit(1)")
    began = monotonic()
    place = bench.machine.root / "root"
    done = tried("/usr/bin/python3", tree / "systemd/debian/build.py", "--output", place, cwd=tree)
    bench.holds(f"built_{version}", done.returncode == 0, done.stderr)
    bench.figures.setdefault("build_s", round(monotonic() - began, 1))
    shutil.rmtree(tree)
    file = Path(done.stdout.strip())
    bench.figures.setdefault("megabytes", round(file.stat().st_size / 1e6))
    return f"/root/{file.name}"


def replaced(file: Path, before: str, after: str) -> None:
    """Replace a text that occurs once in a file."""
    text = file.read_text(encoding="utf-8")
    assert text.count(before) == 1, f"{file.name} has changed: {before!r}"
    file.write_text(text.replace(before, after), encoding="utf-8")


def install(bench: Packages) -> None:
    done = bench.dpkg(__version__)
    bench.holds("deb_installs", done.returncode == 0, done)
    freezable(bench.machine.root / "opt/monstertruckd" / __version__)
    bench.holds("no_service_without_a_configuration", bench.show("LoadState")["LoadState"] == "not-found")
    config = f"{EMULATED}/configs/truck-of-the-benchmark.yaml"
    began = monotonic()
    done = bench.program("install-service", "--config", config, "--start")
    bench.holds("service_starts", done.returncode == 0 and bench.runs(__version__), done)
    bench.within("service_ready_s", monotonic() - began, READY_GOAL)


def upgrades(bench: Packages) -> None:
    bench.holds("drives_before_upgrade", bench.drive())
    done = bench.dpkg(NEXT)
    bench.holds("upgrade_refused_while_armed", done.returncode != 0 and "disarm it first" in done.stderr, done)
    bench.holds("version_before_stays", bench.runs(__version__))
    bench.program("disarm")
    until(lambda: "disarmed" in bench.show("StatusText")["StatusText"], 10)
    began = monotonic()
    done = bench.dpkg(NEXT)
    bench.holds("upgraded", done.returncode == 0 and bench.runs(NEXT), done)
    bench.within("upgrade_s", monotonic() - began, 60.0)
    bench.holds("nothing_of_the_version_before", bench.folders() == {NEXT}, bench.folders())
    began = monotonic()
    done = bench.dpkg(BROKEN)
    bench.holds("broken_fails", done.returncode != 0 and "the version before runs again" in done.stderr, done)
    bench.holds("broken_back_to_the_version_before", bench.runs(NEXT))
    bench.within("broken_s", monotonic() - began, 120.0)
    done = bench.dpkg(NEXT)
    bench.holds("after_broken_installs_again", done.returncode == 0 and bench.runs(NEXT), done)
    done = bench.dpkg(__version__)
    bench.holds("rolled_back", done.returncode == 0 and bench.runs(__version__), done)
    bench.holds("nothing_of_other_versions", bench.folders() == {__version__}, bench.folders())


def second_boot(bench: Packages) -> None:
    bench.holds("active_after_boot", until(bench.active, 60))
    bench.holds("drives_after_boot", bench.drive())


def removal(bench: Packages) -> None:
    began = monotonic()
    done = bench.machine.run("dpkg", "--remove", "monstertruckd", check=False)
    bench.holds("removed", done.returncode == 0, done)
    until(lambda: bench.wire.since(began).stood() is not None, 10)
    bench.holds("removal_stops_the_robot", bench.wire.since(began).stood() is not None)
    root = bench.machine.root
    kept = [root / "etc/monstertruckd/truck-of-the-benchmark.yaml", root / "var/lib/monstertruckd/logs"]
    bench.holds("removal_keeps_configuration_and_logs", all(place.exists() for place in kept))
    bench.holds("removal_takes_program_and_unit", not (root / "opt/monstertruckd").exists() and not bench.active())
    done = bench.machine.run("dpkg", "--purge", "monstertruckd", check=False)
    bench.holds("purged", done.returncode == 0, done)
    left = [
        place
        for folder in ("etc", "opt", "usr", "var/lib/monstertruckd", "var/log", "var/cache")
        for place in (root / folder).rglob("*monstertruckd*")
        if EMULATED.name not in place.parts
    ]
    bench.holds("purge_leaves_nothing", not left, left[:10])
    bench.holds("purge_takes_the_user", bench.machine.run("id", "monstertruckd", check=False).returncode != 0)


def main() -> int:
    """Run both parts; return 0 if all goals are met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = {"wheels": wheels, "debian": debian}
    parser.add_argument("--only", nargs="+", choices=parts, default=list(parts), help="parts to run")
    parser.add_argument("--keep", type=Path, help="keep the machine in this folder, and use the one that is there")
    arguments = parser.parse_args()

    def run(bench: Packages, scratch: Path) -> None:
        for part in arguments.only:
            parts[part](bench, scratch)

    return judged("package", Packages, arguments.keep, run)


if __name__ == "__main__":
    sys.exit(main())
