"""Texts of the installed files: systemd unit and udev rules, from the templates in the folder ``systemd``."""

import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

from monstertruck_drivers.config import AnyPort, CommandPortConfig, Device, PortConfig, TcpPortConfig
from monstertruck_drivers.shafts import stop_words
from monstertruck_drivers.usb.config import CycleMethod, UsbPortConfig
from monstertruck_drivers.usb.tree import is_topology, place, port_directory
from monstertruck_runtime.errors import InputError, NotFoundError
from monstertruckd.config.truck import TruckConfig
from monstertruckd.tools.shipped import shipped

HOMES: Final = (Path("/home"), Path("/root"), Path("/run/user"))
"""Hidden from the service but for the program itself."""
HIDDEN: Final = (Path("/tmp"), Path("/var/tmp"))  # noqa: S108  # lists folders that the service must not run from
LINKS: Final = Path("/dev/truck")
"""Folder of the links that the udev rules make."""
_PLAIN: Final = re.compile(r"/[A-Za-z0-9/._+=,:~-]*")
_USER: Final = re.compile(r"[a-z_][a-z0-9_-]{0,31}")
GROUP = "dialout"
"""Group of the files that the daemon may write below /sys."""


def shipped_file(name: str) -> Path:
    """Return the path of a file of the folder ``systemd``.

    Raises:
        NotFoundError: the installation is incomplete.
    """
    path = shipped(f"systemd/{name}")
    if not path.is_file():
        raise NotFoundError(f"{path} is missing from the installation")
    return path


def filled(name: str, values: dict[str, str]) -> str:
    """Return a shipped file's text with its ``@names@`` replaced; a line of one empty value is removed."""

    def value(match: re.Match[str]) -> str:
        return values[match["name"]]

    text = shipped_file(name).read_text(encoding="utf-8")
    empty = [key for key, replacement in values.items() if not replacement]
    for key in empty:
        text = text.replace(f"@{key}@\n", "")
    return re.sub(r"@(?P<name>[a-z]+)@", value, text)


@dataclass(frozen=True, slots=True)
class Program:
    """Command of the service."""

    python: Path
    """Interpreter, of the environment the packages are in."""
    neutral: Path
    """Stop script."""
    reads: tuple[Path, ...]
    """Folders with the interpreter and all packages."""

    @classmethod
    def present(cls) -> Self:
        """Return the running program."""
        neutral = shipped_file("neutral.py")
        base = Path(sys.base_prefix)  # may be a link in front of the true folder; both names are used
        reads = dict.fromkeys((Path(sys.prefix), base, base.resolve(), neutral.parents[1]))
        return cls(Path(sys.executable), neutral, tuple(reads))


def unit_text(config: TruckConfig, config_file: Path, user: str, program: Program) -> str:
    """Return the text of the unit.

    Args:
        config: configuration whose drives are stopped after a crash.
        config_file: configuration file of the service.
        user: user of the service.
        program: command of the service.

    Raises:
        InputError: systemd or its sandbox could not use the user's name or one of the paths.
    """
    at_home = _at_home(program)
    return filled(
        "monstertruckd.service",
        {
            "python": _plain(program.python),
            "config": _plain(config_file),
            "stop": _stop(config, program),
            "user": user_name(user),
            "home": "tmpfs" if at_home else "yes",
            "bind": "\n".join(f"BindReadOnlyPaths={_plain(place, without=':')}" for place in at_home),
            "switch": "" if config.usb.power.method is None else "ReadWritePaths=-/sys/devices",
        },
    )


def user_name(name: str) -> str:
    """Return ``name`` if it is a valid user name.

    Raises:
        InputError: it is not; a line break in it would add a setting.
    """
    if not _USER.fullmatch(name):
        raise InputError(f"user {name!r}: expected a lower-case letter or _, then at most 31 of a-z 0-9 _ -")
    return name


def node_of(role: str, port: AnyPort) -> Path:
    """Return the path of the device of ``role`` in /dev once the udev rules are installed."""
    return port.path if isinstance(port, PortConfig) else LINKS / role


def _stop(config: TruckConfig, program: Program) -> str:
    drives = [
        f"{_plain(node_of(role, device.port), without='=')}={_stop_words(device, words)}@{device.port.baud}"
        for role, device in config.devices.present().items()
        if not isinstance(device.port, TcpPortConfig | CommandPortConfig)
        and (words := stop_words(device.driver)) is not None
    ]
    # Without site: the script must run even when the environment's packages do not load.
    return f"ExecStopPost={_plain(program.python)} -I -S {_plain(program.neutral)} {' '.join(drives)}" if drives else ""


def _stop_words(device: Device[Any], words: str) -> str:
    """Return the arguments for the stop script, whose default is an EPOS."""
    kind = device.kind.name
    return words if kind == "epos" else f"{kind}:{words}"


def temporary(program: Program) -> str | None:
    """Return why the service could not run ``program``; None if it can."""
    hidden = (place for place in program.reads if any(place.is_relative_to(folder) for folder in HIDDEN))
    place = next(hidden, None)
    return (
        None if place is None else (f"{place}: temporary folder, invisible to a service; install to /opt/monstertruckd")
    )


def _at_home(program: Program) -> list[Path]:
    """Return the paths in hidden folders that the service must still access."""
    return [place for place in program.reads if any(place.is_relative_to(home) for home in HOMES)]


def _plain(path: Path, without: str = "") -> str:
    """Return ``path`` for a unit file.

    Args:
        path: absolute path.
        without: a character that ends a path at that place.

    Raises:
        InputError: it would need quoting.
    """
    if without and without in str(path):
        raise InputError(f"{path}: expected a path without {without}, which ends it in the unit")
    if not _PLAIN.fullmatch(str(path)):
        raise InputError(f"{path}: expected an absolute path of letters, digits and / . _ + = , : ~ - for systemd")
    return str(path)


def rules_text(config: TruckConfig) -> str:
    """Return the complete file."""
    return filled("udev.rules", {"devices": "\n".join(_devices(config))})


def _devices(config: TruckConfig) -> Iterator[str]:
    method = config.usb.power.method
    for role, device in config.devices.present().items():
        if isinstance(device.port, UsbPortConfig):
            yield ""
            yield f"# {role}: {place(device.port.device)}"
            yield from _device(role, device.port, method, camera=device.kind.opens == "video")


def _device(role: str, port: UsbPortConfig, method: CycleMethod | None, *, camera: bool) -> Iterator[str]:
    """Yield the rules of one device, by its interface's name, so that a hub in its port does not match."""
    device, by_topology = port.device, is_topology(port.device)
    # The prefix of the controller in udev's name depends on the board; the bus is not part of it.
    itself, key = (
        (f'ENV{{ID_PATH}}=="*{device}"', "ENV{ID_PATH}") if by_topology else (f'KERNEL=="{device}"', "KERNELS")
    )
    any_interface = f'{key}=="{"*" * by_topology}{device}:*"'
    interface = any_interface.replace(":*", f":*.{port.interface}")
    whole = f'SUBSYSTEM=="usb", ENV{{DEVTYPE}}=="usb_device", {itself}'
    identity = ""
    if port.usb_id is not None:
        vendor, product = port.usb_id.split(":")
        identity = f', ENV{{ID_VENDOR_ID}}=="{vendor}", ENV{{ID_MODEL_ID}}=="{product}"'
    yield f'{whole}, ENV{{ID_MM_DEVICE_IGNORE}}="1", ENV{{PRODUCT}}="truck/{role}", ATTR{{power/control}}="on"'
    if camera:
        # A camera has several nodes; the first one gives the pictures.
        yield f'SUBSYSTEM=="video4linux", {interface}, ATTR{{index}}=="0"{identity}, SYMLINK+="truck/{role}"'
    else:
        yield f'SUBSYSTEM=="tty", {any_interface}, ENV{{ID_MM_PORT_IGNORE}}="1"'
        yield f'SUBSYSTEM=="tty", {interface}{identity}, SYMLINK+="truck/{role}"'
        latency = f'SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", {interface}'
        yield f'{latency}, ATTR{{latency_timer}}="{port.latency_ms}", {_writable("latency_timer")}'
    if method is CycleMethod.AUTHORIZED:
        yield f"{whole}, {_writable('authorized')}"
    elif method is CycleMethod.PORT:
        yield from _switch(port)


def _switch(port: UsbPortConfig) -> Iterator[str]:
    """Yield rules that let the daemon switch a port off: for its hub, and for the other half of a USB 3 hub."""
    hub = f'ENV{{ID_PATH}}=="*{port.hub}:1.0"'
    if not is_topology(port.device):
        hub = f'KERNEL=="{port_directory(port.device).split("/")[-2]}"'
    whole = f'SUBSYSTEM=="usb", ENV{{DEVTYPE}}=="usb_interface", {hub}'
    for switch in (f"*-port{port.port}/disable", f"*-port{port.port}/peer/disable"):
        command = f"for file in /sys%p/{switch}; do chgrp {GROUP} $$file; chmod g+w $$file; done"
        yield f"""{whole}, RUN+="/bin/sh -c '{command}'\""""


def _writable(attribute: str) -> str:
    file = f"/sys%p/{attribute}"
    return f'RUN+="/bin/chgrp {GROUP} {file}", RUN+="/bin/chmod g+w {file}"'
