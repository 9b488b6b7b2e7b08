"""Asks every device who it is, unless a daemon has it."""

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any, Final

from monstertruck_drivers.catalog import DeviceKind
from monstertruck_drivers.config import Device
from monstertruck_drivers.link import BAUD
from monstertruck_drivers.usb.config import UsbPortConfig
from monstertruck_drivers.usb.port import HubPort
from monstertruck_runtime.errors import DeviceError, PortBusyError, WrongDeviceError
from monstertruck_schemas.base import Schema
from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.doctor.finding import Finding, fail, fine, warn
from monstertruckd.tools.doctor.patient import Patient

PATIENCE: Final = 15.0
"""Seconds for one device's whole answer; a scanner that must first be silenced takes some."""


async def handshakes(patient: Patient) -> AsyncIterator[Finding]:
    """One finding per device that is plugged in; all are asked at once."""
    if patient.config is None:
        return
    daemon = patient.daemon()
    if daemon is not None:
        seen = f"not tried: the running daemon (process {daemon}) has the ports"
        yield fine("handshakes", seen, patient.command("status", "--once"))
        return
    plugged = {
        role: (device, node)
        for role, device in patient.config.devices.present().items()
        if (node := patient.node(device.port, camera=device.kind.opens == "video")) is not None
    }
    for found in await asyncio.gather(*(_shake(patient, role, *ends) for role, ends in plugged.items())):
        yield found


async def _shake(patient: Patient, role: str, device: Device[Schema], node: Path) -> Finding:
    check, kind = f"{role} handshake", device.kind
    again = patient.command("probe", role, "--port", str(node))
    try:
        async with patient.computer.machine.clock.deadline(PATIENCE):
            answer = await _ask(patient, role, device, kind, node)
    except TimeoutError:
        return fail(check, Reason.DEVICE_TIMEOUT, f"no end of its answer within {PATIENCE:g} s", again)
    except PortBusyError as error:
        return fail(check, error.reason, str(error), f"sudo fuser -v {node}")
    except WrongDeviceError as error:
        return fail(check, error.reason, str(error), patient.find_port_command(role))
    except DeviceError as error:
        return fail(check, error.reason, str(error), again)
    if kind.opens == "video" and not any(one.get("mjpg_modes") for one in answer["nodes"]):
        return warn(check, Reason.DEVICE_WRONG, f"{node} offers no motion JPEG", again)
    return fine(check, f"{kind.doc} answers")


async def _ask(patient: Patient, role: str, device: Device[Schema], kind: DeviceKind, node: Path) -> dict[str, Any]:
    port, machine = device.port, patient.computer.machine
    if kind.opens == "video":
        return await kind.probe_function()(str(node), machine.clock, device.driver)
    line = (
        HubPort(port, machine, lambda *_, **__: None, role=role)
        if isinstance(port, UsbPortConfig)
        else machine.serial(node, port.baud or BAUD)
    )
    return await kind.probe_function()(line, machine.clock, device.driver)
