"""The udev rules of a configuration: who may be named by hub and port gets its link, its settings, and its peace."""

from collections.abc import Iterator

from monstertruck_drivers.usb.config import CycleMethod, UsbPortConfig
from monstertruck_drivers.usb.tree import place, port_directory
from monstertruckd.config.truck import TruckConfig
from monstertruckd.tools.install.shipped import filled

GROUP = "dialout"
"""Owns what the daemon may write below /sys."""


def rules_text(config: TruckConfig) -> str:
    """The whole file."""
    return filled("udev.rules", {"devices": "\n".join(_devices(config))})


def _devices(config: TruckConfig) -> Iterator[str]:
    method = config.usb.power.method
    for role, device in config.devices.present().items():
        if isinstance(device.port, UsbPortConfig):
            yield ""
            yield f"# {role}: {place(device.port.device)}"
            yield from _device(role, device.port, method, camera=device.kind.opens == "video")


def _device(role: str, port: UsbPortConfig, method: CycleMethod | None, *, camera: bool) -> Iterator[str]:
    """Rules of one device; by its interface's name, as a hub in its port must not pass for it."""
    whole = f'SUBSYSTEM=="usb", ENV{{DEVTYPE}}=="usb_device", KERNEL=="{port.device}"'
    interface = f'KERNELS=="{port.device}:*.{port.interface}"'
    identity = ""
    if port.usb_id is not None:
        vendor, product = port.usb_id.split(":")
        identity = f', ENV{{ID_VENDOR_ID}}=="{vendor}", ENV{{ID_MODEL_ID}}=="{product}"'
    yield f'{whole}, ENV{{ID_MM_DEVICE_IGNORE}}="1", ATTR{{power/control}}="on"'
    if camera:
        # A camera has several nodes; the first one gives the pictures.
        yield f'SUBSYSTEM=="video4linux", {interface}, ATTR{{index}}=="0"{identity}, SYMLINK+="truck/{role}"'
    else:
        yield f'SUBSYSTEM=="tty", KERNELS=="{port.device}:*", ENV{{ID_MM_PORT_IGNORE}}="1"'
        yield f'SUBSYSTEM=="tty", {interface}{identity}, SYMLINK+="truck/{role}"'
        latency = f'SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", {interface}'
        yield f'{latency}, ATTR{{latency_timer}}="{port.latency_ms}", {_writable("latency_timer")}'
    if method is CycleMethod.AUTHORIZED:
        yield f"{whole}, {_writable('authorized')}"
    elif method is CycleMethod.PORT:
        *_, hub, switch = port_directory(port.device).split("/")
        yield f'SUBSYSTEM=="usb", ENV{{DEVTYPE}}=="usb_interface", KERNEL=="{hub}", {_writable(f"{switch}/disable")}'


def _writable(attribute: str) -> str:
    file = f"/sys%p/{attribute}"
    return f'RUN+="/bin/chgrp {GROUP} {file}", RUN+="/bin/chmod g+w {file}"'
