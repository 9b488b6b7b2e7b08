"""Image of ``systemd/container/Dockerfile``, and a lap of the emulated truck in it.

    python benchmarks/container.py [--chroot] [--keep FOLDER]

``buildah`` builds the image if it is installed; without it, or with ``--chroot``, each step runs by ``chroot``. In both
cases ``mmdebstrap`` makes the Debian named by the first step, because an image registry may be unreachable (needs root,
Debian's packages and a package index). Then the truck drives its lap as the image's user. The last line is JSON.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks import ROOT
from benchmarks.service_parts.machine import PASSED_ON

FILE = ROOT / "systemd" / "container" / "Dockerfile"
CERTIFICATES = Path("/etc/ssl/certs/ca-certificates.crt")
GOALS = {"failed_steps": 0, "lap": "path driven to its end"}


def steps(text: str) -> Iterator[tuple[str, str]]:
    """Yield instruction and arguments of each step, without comments, with joined lines."""
    plain = "\n".join(line for line in text.splitlines() if not line.startswith("#"))
    for line in plain.replace("\\\n", " ").splitlines():
        name, _, rest = line.partition(" ")
        if name:
            yield name, rest.strip()


class Image:
    """A root folder, and the state that the steps so far define for the next command.

    Args:
        folder: root folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._environment = {"PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin", "HOME": "/root"}
        self._environment["SSL_CERT_FILE"] = str(CERTIFICATES)
        self._passed = {name: os.environ[name] for name in PASSED_ON if name in os.environ}
        self._place, self._user = "/", "0"

    def step(self, name: str, rest: str) -> int:
        """Execute a step; return the exit code of its command."""
        match name:
            case "FROM":
                suite = rest.removeprefix("debian:").removesuffix("-slim")
                words = ["mmdebstrap", "--quiet", "--variant=minbase", suite, str(self.folder)]
                return subprocess.run(words, check=False).returncode
            case "RUN":
                return self.run(rest).returncode
            case "COPY":
                listed = subprocess.run(["git", "archive", "HEAD"], cwd=ROOT, capture_output=True, check=True).stdout
                words = ["tar", "--extract", "--directory", str(self.folder / self._place.lstrip("/"))]
                return subprocess.run(words, input=listed, check=False).returncode
            case "WORKDIR":
                self._place = rest
                (self.folder / rest.lstrip("/")).mkdir(parents=True, exist_ok=True)
            case "ENV":
                for key, value in re.findall(r"(\w+)=(\S+)", rest):
                    self._environment[key] = value.replace("$PATH", self._environment["PATH"])
            case "USER":
                self._user = rest
        return 0

    def run(self, command: str) -> "subprocess.CompletedProcess[str]":
        """Run a shell command as the current user in the current folder, with this computer's certificates."""
        for file in (Path("/etc/resolv.conf"), CERTIFICATES):  # each time: a step may install Debian's own
            there = self.folder / file.relative_to("/")
            there.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(file, there)
        return subprocess.run(
            ["chroot", f"--userspec={self._user}:{self._user}", str(self.folder), "/bin/sh", "-c",
             f"cd {self._place} && {command}"],
            env=self._environment | self._passed, capture_output=True, text=True, check=False,
        )  # fmt: skip


IMAGE = "localhost/monstertruckd-measured"


def imported_base(name: str, folder: Path) -> None:
    """Make the base image of a container file, with this computer's certificates and package index."""
    suite = name.removeprefix("debian:").removesuffix("-slim")
    place = Path("usr/local/share/ca-certificates/computer.crt")  # ca-certificates adds it to its bundle
    (folder / place).parent.mkdir(parents=True)
    shutil.copy(CERTIFICATES, folder / place)
    archive = folder / "base.tar"
    subprocess.run(["mmdebstrap", "--quiet", "--variant=minbase", suite, str(archive)], check=True)
    subprocess.run(["tar", "--append", f"--file={archive}", f"--directory={folder}", f"./{place}"], check=True)
    passed = {name: os.environ[name] for name in PASSED_ON if name in os.environ} | {"SSL_CERT_FILE": str(CERTIFICATES)}
    settings = [f"--env={key}={value}" for key, value in passed.items()]
    made = run_buildah("from", "scratch")
    run_buildah("add", made, str(archive), "/")
    run_buildah("config", *settings, made)
    run_buildah("commit", "--quiet", made, f"docker.io/library/{name}")
    run_buildah("rm", made)


def run_buildah(*words: str) -> str:
    """Return the output of a ``buildah`` command."""
    done = subprocess.run(["buildah", *words], cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True)
    return done.stdout.strip()


def built_by_buildah(folder: Path) -> dict[str, Any]:
    """Build the image and drive the lap in it."""
    begin = time.monotonic()
    imported_base(next(rest for name, rest in steps(FILE.read_text(encoding="utf-8")) if name == "FROM"), folder)
    # chroot: needs neither control groups nor a network of its own
    words = ["buildah", "build", "--isolation=chroot", "--pull-never", f"--tag={IMAGE}", f"--file={FILE}", str(ROOT)]
    failed = subprocess.run(words, stdout=sys.stderr, check=False).returncode != 0
    figures: dict[str, Any] = {"failed_steps": int(failed), "seconds": {"build": round(time.monotonic() - begin, 1)}}
    if failed:
        return figures | {"lap": ""}
    container = run_buildah("from", "--pull-never", IMAGE)
    lap = ["buildah", "run", "--isolation=chroot", container, "--", *LAP]
    done = subprocess.run(lap, capture_output=True, text=True, check=False)
    run_buildah("rm", container)
    return figures | {"lap": outcome(done)}


LAP = ("monstertruckd", "demo", "--fast", "--output", "/tmp/lap")


def outcome(done: "subprocess.CompletedProcess[str]") -> str:
    """Describe the end of a lap."""
    found = re.search(r"outcome\s+(.*)", done.stdout)
    return found[1].strip() if found else (done.stderr or done.stdout).strip()[-500:]


def carried_out(folder: Path) -> dict[str, Any]:
    """Execute the steps of the container file by ``chroot``, and drive the lap."""
    figures: dict[str, Any] = {"failed_steps": 0, "seconds": {}}
    image = Image(folder)
    for number, (instruction, rest) in enumerate(steps(FILE.read_text(encoding="utf-8")), 1):
        begin = time.monotonic()
        code = image.step(instruction, rest)
        figures["failed_steps"] += code != 0
        figures["seconds"][f"{number} {instruction}"] = round(time.monotonic() - begin, 1)
        print(f"{number} {instruction}: {code}", file=sys.stderr, flush=True)
    return figures | {"lap": outcome(image.run(" ".join(LAP)))}


def main() -> int:
    """Measure; 0 = all goals are met."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--chroot", action="store_true", help="carry out the steps, though buildah is installed")
    parser.add_argument("--keep", metavar="FOLDER", type=Path, help="empty folder for the root, which is kept")
    given = parser.parse_args()
    by_steps = given.chroot or given.keep is not None or shutil.which("buildah") is None
    with TemporaryDirectory(prefix="container-", ignore_cleanup_errors=True) as name:
        figures = carried_out(given.keep or Path(name)) if by_steps else built_by_buildah(Path(name))
    figures["built_by"] = "chroot" if by_steps else "buildah"
    met = all(figures[name] == goal for name, goal in GOALS.items())
    print(json.dumps({"bench": "container", "figures": figures, "goals": GOALS, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
