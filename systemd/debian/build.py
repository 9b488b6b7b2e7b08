"""Build the Debian package of this checkout.

    python3 systemd/debian/build.py [--output FOLDER]

The package contains the program with all packages that the lock file pins for a robot (hashes checked), in a separate
environment in ``/opt/monstertruckd/VERSION``. It works with the Python of the computer that builds it, so build it on
the Debian release of the robot. The build needs ``dpkg-deb`` and the package index, but no root; it uses only Python's
standard library.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path.insert(0, str(ROOT))

from monstertruckd import __version__
from monstertruckd.bootstrap import find_uv

PYTHON = Path("/usr/bin/python3")
"""Interpreter of the robot's Debian; the environment's is a link to it."""
PROGRAM = Path("opt/monstertruckd") / __version__
EXTRAS = ("robot", "slam", "planning", "station", "plot")
"""Of a robot that maps, plans and serves its page."""
SCRIPTS = ("preinst", "postinst", "prerm", "postrm")
CONTROL = """\
Package: monstertruckd
Version: {version}
Architecture: {architecture}
Maintainer: The monstertruckd authors <monstertruckd@localhost>
Installed-Size: {kilobytes}
Depends: python3 (>= {python}), python3 (<< {next_python}), libc6 (>= 2.28), systemd, udev
Recommends: uhubctl, v4l-utils
Section: science
Priority: optional
Description: daemon of a four-wheel-steer robot truck
 One asyncio process owns every device of the robot, drives it through one safety gate,
 publishes its state on Zenoh and records everything.
 .
 The service runs once `monstertruckd install-service --config FILE --start` has named a
 configuration; upgrades of this package then restart it and go back by themselves if the
 new version does not become ready.
"""


def build(output: Path) -> Path:
    """Build the package.

    Args:
        output: Folder of the package; made where it is missing.

    Returns:
        The package's file.

    Raises:
        subprocess.CalledProcessError: A program failed; it has printed why.
    """
    output.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix="monstertruckd-deb-") as scratch:
        stage = Path(scratch) / "root"
        environment(stage / PROGRAM, Path(scratch))
        command = stage / "usr/bin/monstertruckd"
        command.parent.mkdir(parents=True)
        command.symlink_to(Path("/") / PROGRAM / "bin/monstertruckd")
        documents = stage / "usr/share/doc/monstertruckd"
        documents.mkdir(parents=True)
        shutil.copy(ROOT / "LICENSE", documents / "copyright")
        control(stage)
        package = output / f"monstertruckd_{__version__}_{architecture()}.deb"
        run("dpkg-deb", "--root-owner-group", "-Zzstd", "--build", stage, package)
    return package


def environment(place: Path, scratch: Path) -> None:
    """Make the environment: the pinned packages, then this checkout's wheel."""
    uv = find_uv()
    extras = [flag for extra in EXTRAS for flag in ("--extra", extra)]
    wanted = scratch / "requirements.txt"
    run(uv, "export", "--quiet", "--frozen", "--no-emit-project", "--no-dev", *extras, "--output-file", wanted)
    run(uv, "build", "--quiet", "--system-certs", "--wheel", "--out-dir", scratch / "wheel")
    (wheel,) = (scratch / "wheel").glob("*.whl")
    run(uv, "venv", "--quiet", "--relocatable", "--python", PYTHON, place)
    install = (uv, "pip", "install", "--quiet", "--system-certs", "--compile-bytecode", "--link-mode", "copy")
    into = ("--python", place / "bin/python")
    run(*install, *into, "--require-hashes", "--requirements", wanted)
    run(*install, *into, "--no-deps", wheel)


def control(stage: Path) -> None:
    """Write what dpkg needs to know, and the scripts that it runs."""
    folder = stage / "DEBIAN"
    folder.mkdir()
    major, minor = map(int, run(PYTHON, "-c", "import sys; print(*sys.version_info[:2])").split())
    facts = {
        "version": __version__,
        "architecture": architecture(),
        "kilobytes": int(run("du", "--summarize", "--block-size=1024", stage).split()[0]),
        "python": f"{major}.{minor}",
        "next_python": f"{major}.{minor + 1}",
    }
    (folder / "control").write_text(CONTROL.format_map(facts), encoding="utf-8")
    for name in SCRIPTS:
        text = (HERE / name).read_text(encoding="utf-8")
        script = folder / name
        script.write_text(re.sub(r"@version@", __version__, text), encoding="utf-8")
        script.chmod(0o755)


def architecture() -> str:
    """Return Debian's name of this computer's architecture."""
    return run("dpkg", "--print-architecture").strip()


def run(*command: str | Path) -> str:
    """Run a program from the checkout; return what it prints."""
    quiet = {name: value for name, value in os.environ.items() if name != "VIRTUAL_ENV"}
    words = [str(word) for word in command]
    return subprocess.run(words, cwd=ROOT, env=quiet, check=True, stdout=subprocess.PIPE, text=True).stdout


def main() -> None:
    """Build it and print where it is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=ROOT / "dist", help="folder of the package (default: dist)")
    print(build(parser.parse_args().output.absolute()))


if __name__ == "__main__":
    main()
