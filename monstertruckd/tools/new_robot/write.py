"""Writes a new robot's folder: its configuration, the simulation, and the twin that includes both."""

import os
import shutil
import tempfile
from pathlib import Path
from typing import Final

from monstertruck_drivers.usb.tree import TreeSnapshot
from monstertruck_runtime.errors import ConfigError, InputError
from monstertruck_runtime.yaml_files import yaml_text
from monstertruckd.config.load import load_config
from monstertruckd.config.truck import TruckConfig
from monstertruckd.tools.install.files import LINKS
from monstertruckd.tools.new_robot import compose
from monstertruckd.tools.new_robot.answers import Answers
from monstertruckd.tools.shipped import shipped
from monstertruckd.tools.simulation.config import load_simulated

NAVIGATION: Final = "configs/parts/navigation.yaml"
ROBOT, SIMULATION, TWIN = "robot.yaml", "simulation.yaml", "twin.yaml"


def write_robot(answers: Answers, parent: Path, tree: TreeSnapshot) -> Path:
    """Write the folder of a robot; both configurations are valid, or nothing is written.

    Args:
        answers: description of the robot.
        parent: folder in which the robot's folder is created, with the robot's name.
        tree: USB devices of this computer.

    Raises:
        InputError: the folder exists or cannot be created, or the description is impossible.
    """
    folder = parent / answers.name
    if folder.exists():
        raise InputError(f"{folder}: exists; choose another name, or another place with --folder")
    try:
        parent.mkdir(parents=True, exist_ok=True)
        scratch = Path(tempfile.mkdtemp(prefix=f".{answers.name}-", dir=parent))
    except OSError as error:
        raise InputError(f"{parent}: {error.strerror}") from error
    try:
        for name, text in texts(answers, folder, tree).items():
            (scratch / name).write_text(text, encoding="utf-8")
        load_config(scratch / ROBOT, TruckConfig)
        load_simulated(scratch / TWIN)
        scratch.chmod(0o755)
        scratch.rename(folder)
    except ConfigError as error:
        raise InputError(f"such a robot is impossible: {str(error).replace(str(scratch), str(folder))}") from error
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    return folder


def texts(answers: Answers, folder: Path, tree: TreeSnapshot) -> dict[str, str]:
    """The files by name."""
    own = compose.robot(answers, tree, _named_from(folder, shipped(NAVIGATION)))
    heads = {
        ROBOT: "The robot. Omitted values have the defaults that `monstertruckd config show` prints.",
        SIMULATION: "The simulation: emulated ports, a world, and the true dimensions of the robot.",
        TWIN: "The simulated twin: includes the robot and the simulation.",
    }
    sections = {ROBOT: own, SIMULATION: compose.simulated(answers), TWIN: compose.twin(ROBOT, SIMULATION)}
    return {name: f"# {head}\n{yaml_text(sections[name])}" for name, head in heads.items()}


def next_commands(folder: Path) -> list[str]:
    """What to enter next: check both, map a room with the twin, name the ports of the robot."""
    config = load_config(folder / ROBOT, TruckConfig)[0]
    drive = f"monstertruckd drive --robot {config.robot}"
    explore = f"monstertruckd explore --arm --robot {config.robot}"
    unknown = [
        f"monstertruckd find-port {role} --write {folder / ROBOT}"
        for role, device in config.devices.present().items()
        if device.port.label == str(LINKS / role)
    ]
    return [
        f"monstertruckd config show {folder / ROBOT}",
        f"monstertruckd simulate --run --config {folder / TWIN}",
        drive if config.explorer is None else explore,
        *unknown,
        f"monstertruckd install-service --config {folder / ROBOT}",
    ]


def _named_from(folder: Path, file: Path) -> str:
    """``file`` relative to the folder within one checkout, so that both can move together; else its path."""
    file, home = file.resolve(), folder.resolve()
    checkout = file.parents[2]
    return os.path.relpath(file, home) if home.is_relative_to(checkout) else str(file)
