"""The error tree: every expected failure of the project derives from ``TruckError`` and knows its reason."""

import errno
from pathlib import Path
from typing import ClassVar, TypeVar

from monstertruck_schemas.reasons import Reason

E = TypeVar("E", bound=BaseException)


class TruckError(Exception):
    """Root of all expected failures; any other exception is a bug."""

    reason: ClassVar[Reason] = Reason.INTERNAL


class ConfigError(TruckError):
    """A configuration is invalid; the text names file, line, key and expected value."""

    reason = Reason.BAD_CONFIG


class UnusableFileError(ConfigError):
    """A file written by the robot, such as saved settings or a calibration, cannot be used.

    Args:
        file: path of the file.
        why: text that names file, place and expected content.
    """

    def __init__(self, file: Path, why: str) -> None:
        super().__init__(why)
        self.file = file


class InputError(TruckError):
    """Other input (map, log, path, argument) is invalid; the text states the expected content."""

    reason = Reason.BAD_INPUT


class DamagedFileError(InputError):
    """A service's file is damaged; a retry is useless."""

    reason = Reason.FILE_DAMAGED


class NotFoundError(TruckError):
    """A named file, key or robot does not exist."""

    reason = Reason.NOT_FOUND


class BusyError(TruckError):
    """Another process already uses an endpoint or a robot's name."""

    reason = Reason.BUSY


class NotInstalledError(TruckError):
    """A library from an extra is not installed."""

    reason = Reason.NOT_INSTALLED


class NotPermittedError(TruckError):
    """The user lacks a permission; the text explains how to get it."""

    reason = Reason.NOT_PERMITTED


class CommandFailedError(TruckError):
    """An external program failed; the text is its output."""

    reason = Reason.COMMAND_FAILED


class NoAnswerError(TruckError):
    """A robot did not answer in time."""

    reason = Reason.TIMEOUT


class RequestRefusedError(TruckError):
    """The robot refused a request."""

    def __init__(self, refusal: Reason, text: str = "") -> None:
        super().__init__(text or refusal.text)
        self.refusal = refusal


class DeviceError(TruckError):
    """Any failure of a device or its link; the supervisor restarts the service."""

    reason = Reason.DEVICE_FAULT


class DeviceLostError(DeviceError):
    """The port disappeared or was closed: unplugged."""

    reason = Reason.DEVICE_LOST


class DeviceWedgedError(DeviceLostError):
    """The device accepts no bytes, or the kernel waits for it when its port is opened or closed."""

    reason = Reason.DEVICE_WEDGED


class DeviceRestartedError(DeviceLostError):
    """The device restarted while its link stayed up: its settings are lost."""

    reason = Reason.DEVICE_RESTARTED


class DeviceStoppedError(DeviceError):
    """The device stopped without a command of this program: a hardware line or another master did it."""

    reason = Reason.DEVICE_STOPPED


class DeviceTimeoutError(DeviceError):
    """The device did not answer in time."""

    reason = Reason.DEVICE_TIMEOUT


class ProtocolError(DeviceError):
    """The device violated its protocol."""

    reason = Reason.DEVICE_PROTOCOL


class WrongDeviceError(DeviceError):
    """The handshake shows another device on this port."""

    reason = Reason.DEVICE_WRONG


class DeviceFaultError(DeviceError):
    """The device reports an internal fault that did not clear."""

    reason = Reason.DEVICE_FAULT


class PortBusyError(DeviceError):
    """Another process holds the port."""

    reason = Reason.DEVICE_BUSY


class DeviceMismatchError(DeviceError):
    """The device's parameters contradict the configuration; a retry is useless."""

    reason = Reason.DEVICE_MISMATCH


class WorkerError(TruckError):
    """A worker process failed."""

    reason = Reason.WORKER_DIED


class WorkerTimeoutError(WorkerError):
    """A worker missed its deadline and was killed."""

    reason = Reason.WORKER_TIMEOUT


def disk_reason(error: OSError) -> Reason:
    """Reason of a failed write: disk full or another failure."""
    return Reason.DISK_FULL if error.errno in {errno.ENOSPC, errno.EDQUOT} else Reason.RECORDING_FAILED


def first_of(error: BaseException, kind: type[E]) -> E | None:
    """Return the first exception of a kind in an exception, possibly a group; None without one."""
    if isinstance(error, BaseExceptionGroup):
        found = (first_of(each, kind) for each in error.exceptions)
        return next((each for each in found if each is not None), None)
    return error if isinstance(error, kind) else None
