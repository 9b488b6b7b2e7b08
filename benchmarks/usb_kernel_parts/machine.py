"""A Debian kernel in QEMU with USB hubs and adapters, whose file system is this computer's, read-only."""

import gzip
import json
import re
import shutil
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import monotonic, sleep
from typing import Any

PROGRAMS = {"qemu-system-x86_64": "qemu-system-x86", "busybox": "busybox-static", "udevadm": "udev"}
"""Programs and the Debian packages that bring them."""
MODULES = (
    "virtio_pci",
    "9pnet_virtio",
    "9p",
    "xhci_pci",
    "usbserial",
    "ftdi_sio",
    "cdc_acm",
    "usbhid",
    "hid_generic",
    "joydev",
    "evdev",
    "usb_f_acm",
    "usb_f_hid",
    "g_serial",
)
"""Kernel modules of the machine, with what they depend on; ``dummy_hcd`` comes with its own parameter."""
ADAPTERS = {"s1": ("h1", 1), "s2": ("h1", 2), "s3": ("h2", 1)}
"""FTDI adapters: hub and port."""
HUBS = {"h1": 1, "h2": 2}
"""Hubs: port of the root hub."""
CMDLINE = "console=ttyS0 panic=1 quiet net.ifnames=0 no_timer_check"
"""Parameters of the kernel. Its check of the timer panics where this computer is too busy for ten ticks in time."""
INIT = """#!/bin/busybox sh
/bin/busybox --install -s /bin
mount -t proc proc /proc; mount -t sysfs sys /sys; mount -t devtmpfs dev /dev
for module in $(cat /modules/order); do insmod /modules/$module; done
insmod /modules/dummy_hcd.ko num=2
mount -t 9p -o trans=virtio,version=9p2000.L,msize=262144,cache=loose,ro root /root
mkdir /share; mount -t 9p -o trans=virtio,version=9p2000.L share /share
for each in proc sys dev; do mount -o move /$each /root/$each; done
mount -t tmpfs tmpfs /root/run; mkdir -p /root/run/share /root/run/udev/rules.d /root/run/lock
mount -o move /share /root/run/share
mount -t tmpfs tmpfs /root/var/tmp; mount -t tmpfs tmpfs /root/home
mount -t tracefs trace /root/sys/kernel/tracing
mount -t configfs config /root/sys/kernel/config
mkdir -p /root/dev/pts; mount -t devpts pts /root/dev/pts
ip link set lo up
chroot /root /bin/sh -c 'export SYSTEMD_IGNORE_CHROOT=1; @command@' > /root/run/share/console.txt 2>&1; code=$?
dmesg > /root/run/share/kernel.txt; echo $code > /root/run/share/exit
sync; poweroff -f
"""


class MissingError(Exception):
    """A program or package needed by the machine is missing."""


def require() -> None:
    """Require the programs.

    Raises:
        MissingError: some are missing; the text names their packages.
    """
    missing = [package for program, package in PROGRAMS.items() if shutil.which(program) is None]
    if missing:
        raise MissingError(f"not installed: {', '.join(missing)}")


def kernel(folder: Path) -> Path:
    """Download the latest Debian kernel and unpack it, once.

    Returns:
        Folder with its ``boot`` and ``lib``.

    Raises:
        MissingError: there is no package index, or no such package.
    """
    unpacked = folder / "kernel"
    if not list(unpacked.glob("boot/vmlinuz-*")):
        folder.mkdir(parents=True, exist_ok=True)
        depends = subprocess.run(
            ["apt-cache", "depends", "linux-image-amd64"], check=False, capture_output=True, text=True
        )
        found = re.search(r"Depends: (linux-image-\S+)", depends.stdout)
        if found is None:
            raise MissingError("no package linux-image-amd64: run apt-get update")
        download = ["apt-get", "download", "-qq", found[1]]
        if subprocess.run(download, check=False, cwd=folder, capture_output=True).returncode:
            raise MissingError(f"{found[1]} cannot be downloaded")
        (package,) = folder.glob("linux-image-*.deb")
        subprocess.run(["dpkg-deb", "-x", package, unpacked], check=True)
        package.unlink()
    return unpacked


def ordered_modules(unpacked: Path, wanted: tuple[str, ...]) -> list[Path]:
    """Return the files of modules, each after its dependencies."""
    files = {path.stem.replace("-", "_"): path for path in unpacked.glob("lib/modules/*/kernel/**/*.ko")}
    order: dict[str, Path] = {}

    def add(name: str) -> None:
        path = files.get(name)
        if path is None or name in order:  # built into the kernel
            return
        data = path.read_bytes()
        for listed in re.findall(rb"\0depends=([^\0]*)\0", b"\0" + data):
            for dependency in filter(None, listed.decode().split(",")):
                add(dependency.replace("-", "_"))
        order[name] = path

    for name in wanted:
        add(name.replace("-", "_"))
    return list(order.values())


def initramfs(unpacked: Path, folder: Path, command: str) -> Path:
    """Pack busybox, kernel modules and the init program; return the initramfs."""
    root = folder / "initramfs"
    shutil.rmtree(root, ignore_errors=True)
    for name in ("bin", "proc", "sys", "dev", "root", "modules"):
        (root / name).mkdir(parents=True)
    shutil.copy(str(shutil.which("busybox")), root / "bin" / "busybox")
    before = [path for path in ordered_modules(unpacked, (*MODULES, "dummy_hcd")) if path.stem != "dummy_hcd"]
    late = ("g_serial", "usb_f_acm", "u_serial", "usb_f_serial", "usb_f_obex")
    for path in [*before, *ordered_modules(unpacked, ("dummy_hcd",))]:
        shutil.copy(path, root / "modules" / path.name)
    order = [path.name for path in before if path.stem not in late]
    (root / "modules" / "order").write_text("\n".join(order) + "\n")
    gadget = [path.name for path in before if path.stem in late]
    script = INIT.replace("num=2", "num=2\n" + "\n".join(f"insmod /modules/{name}" for name in gadget))
    (root / "init").write_text(script.replace("@command@", command))
    (root / "init").chmod(0o755)
    names = "\n".join(str(path.relative_to(root)) for path in [root, *root.rglob("*")])
    pack = ["busybox", "cpio", "-o", "-H", "newc"]
    packed = subprocess.run(pack, check=True, cwd=root, input=names.encode(), capture_output=True)
    image = folder / "initrd.gz"
    image.write_bytes(gzip.compress(packed.stdout, 1))
    return image


@dataclass
class Machine:
    """A running machine.

    The program inside requests changes by files: ``ask/N`` contains a request, ``answer/N`` the answer.
    """

    share: Path
    qemu: subprocess.Popen[bytes]
    monitor: socket.socket

    def serve(self, seconds: float) -> int | None:
        """Answer requests until the machine ends.

        Returns:
            Exit code of the program inside; None if it did not end in time.
        """
        end, number = monotonic() + seconds, 0
        asks, answers = self.share / "ask", self.share / "answer"
        while self.qemu.poll() is None and monotonic() < end:
            ask = asks / str(number)
            if not ask.exists():
                sleep(0.02)
                continue
            text = json.dumps(self.do(json.loads(ask.read_text())))
            scratch = answers / f".{number}"
            scratch.write_text(text)
            scratch.rename(answers / str(number))
            number += 1
        code = self.share / "exit"
        return int(code.read_text()) if code.exists() else None

    def do(self, request: dict[str, Any]) -> Any:
        """Execute a request in QEMU; return its answer."""
        self.monitor.sendall(json.dumps(request).encode() + b"\n")
        buffer = b""
        while True:
            buffer += self.monitor.recv(1 << 16)
            for line in buffer.splitlines():
                with_answer = json.loads(line) if line.endswith(b"}") else {}
                if "return" in with_answer or "error" in with_answer:
                    return with_answer


def adapter(name: str) -> list[str]:
    """Return QEMU's arguments for one adapter."""
    hub, port = ADAPTERS[name]
    place = f"{HUBS[hub]}.{port}"
    return ["-device", f"usb-serial,id={name},chardev=c-{name},port={place},always-plugged=on,serial=SN{name}"]


@contextmanager
def booted(unpacked: Path, image: Path, folder: Path, lines: dict[str, Path]) -> Iterator[Machine]:
    """Boot the machine.

    Args:
        unpacked: folder of the kernel.
        image: initial file system.
        folder: folder for sockets and the machine's output.
        lines: a Unix socket for the far end of each adapter's line.
    """
    share = folder / "share"
    shutil.rmtree(share, ignore_errors=True)
    for name in ("ask", "answer"):
        (share / name).mkdir(parents=True)
    monitor = folder / "monitor"
    monitor.unlink(missing_ok=True)
    (vmlinuz,) = unpacked.glob("boot/vmlinuz-*")
    command = ["qemu-system-x86_64", "-accel", "tcg,thread=multi", "-cpu", "max"]
    command += ["-smp", "2", "-m", "2048", "-display", "none", "-no-reboot", "-serial", f"file:{folder / 'serial.txt'}"]
    command += ["-kernel", str(vmlinuz), "-initrd", str(image), "-append", CMDLINE]
    command += ["-virtfs", "local,path=/,mount_tag=root,security_model=none,readonly=on,multidevs=remap"]
    command += ["-virtfs", f"local,path={share},mount_tag=share,security_model=none"]
    command += ["-qmp", f"unix:{monitor},server=on,wait=off", "-device", "qemu-xhci,id=x,p2=8,p3=8"]
    for hub, port in HUBS.items():
        command += ["-device", f"usb-hub,id={hub},bus=x.0,port={port},port-power=on"]
    for name, path in lines.items():
        command += ["-chardev", f"socket,id=c-{name},path={path},server=on,wait=off", *adapter(name)]
    qemu = subprocess.Popen(command, stdin=subprocess.DEVNULL)
    try:
        link = socket.socket(socket.AF_UNIX)
        end = monotonic() + 20
        while True:
            try:
                link.connect(str(monitor))
                break
            except OSError:
                if monotonic() > end or qemu.poll() is not None:
                    raise
                sleep(0.05)
        machine = Machine(share, qemu, link)
        link.recv(1 << 16)
        machine.do({"execute": "qmp_capabilities"})
        yield machine
    finally:
        qemu.kill()
        qemu.wait()
