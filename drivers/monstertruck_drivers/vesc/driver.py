"""Driver for VESCs on one port: ``cmd/drive*`` and ``cmd/steering`` in; motor, servo and battery feedback out.

One exchange per cycle with every controller sends its set-point and receives its values. A quick stop is a brake
current, repeated in every cycle; a disabled motor coasts.

Every set-point resets the controller's watchdog, which is set at the start of a session and brakes when the host is
silent. A session brakes the motors at its start, and again at its end until they are at rest; then they coast.
"""

import contextlib
import math
from collections.abc import Sequence
from typing import NamedTuple, Unpack

from monstertruck_drivers.battery.monitor import BatteryMonitor
from monstertruck_drivers.link import Link, Port
from monstertruck_drivers.motors import MotorBoard, ShaftEnds, requested
from monstertruck_drivers.vesc.config import RAD_S_PER_RPM, VescConfig
from monstertruck_drivers.vesc.protocol import (
    TICKS_PER_ELECTRICAL_TURN,
    MotorValues,
    WatchdogSetting,
    fault_text,
    set_brake,
    set_current,
    set_rpm,
    set_servo,
    step,
)
from monstertruck_drivers.vesc.session import ATTEMPTS, VescSession
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import DeviceError, DeviceLostError, DeviceRestartedError
from monstertruck_runtime.ports import EventSink, Publisher, Subscription
from monstertruck_schemas.cmd import DriveCommand, SteeringCommand
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import Battery, DriveFeedback, DriveMode, SteeringFeedback


class VescSetpoint(NamedTuple):
    """Motor set-points."""

    mode: DriveMode
    """DISABLED, QUICK_STOP or ENABLED."""
    rpm: tuple[float, ...] = ()
    """Motor speeds for ENABLED (rpm), forward positive."""


def setpoint_of(commands: Sequence[DriveCommand | None], now: int, config: VescConfig) -> VescSetpoint:
    """Combine the latest commands of all shafts into set-points; a stale command brakes its motor.

    Args:
        commands: latest command for every shaft, if any.
        now: current time (ns).
        config: limits and timeouts.
    """
    mode, known = requested(commands, now, config.command_timeout)
    if mode is not DriveMode.ENABLED:
        return VescSetpoint(mode)
    limit = config.max_motor_rpm
    wanted = (command.motor_velocity / RAD_S_PER_RPM for command in known)
    return VescSetpoint(DriveMode.ENABLED, tuple(min(max(rpm, -limit), limit) for rpm in wanted))


def payload_of(setpoint: VescSetpoint, i: int, config: VescConfig) -> bytes:
    """Return the payload for motor ``i``."""
    if setpoint.mode is DriveMode.DISABLED:
        return set_current(0.0)
    rpm = setpoint.rpm[i] if setpoint.rpm else 0.0
    if rpm == 0.0 or abs(rpm) < config.min_motor_rpm:
        return set_brake(config.brake_current)
    return set_rpm(round(rpm * config.pole_pairs) * (-1 if config.motors[i].inverted else 1))


class VescDriver(MotorBoard[VescConfig, VescSession]):
    """Drive service for all motors on one port, with servo output and battery voltage; see ``MotorBoard``.

    Args:
        config: see ``VescConfig``.
        port: the first controller's port.
        clock: time.
        steering_commands: ``cmd/steering``.
        drive: feedback from the first motor, whose current explains the battery sag.
        steering: position sent to the servo, as an angle; None if another device steers.
        battery: pack voltage; None if another device measures the battery.
        events: identity, restarts and faults.
        name: service name.
        ends: the shafts' topics.
    """

    def __init__(
        self,
        config: VescConfig,
        port: Port,
        clock: Clock,
        *,
        steering_commands: Subscription[SteeringCommand],
        drive: Subscription[DriveFeedback],
        steering: Publisher[SteeringFeedback] | None,
        battery: Publisher[Battery] | None,
        events: EventSink,
        name: str = "actuators",
        **ends: Unpack[ShaftEnds],
    ) -> None:
        super().__init__(config, port, clock, config.shafts, events, name, ends)
        self._steering_commands = steering_commands
        self._steering = None if config.servo is None else steering
        self._battery: BatteryMonitor | None = None
        if battery is not None and config.battery is not None:
            self._battery = BatteryMonitor(config.battery, battery, events, name, drive)
        self._battery_due = 0
        self._ticks = [0] * config.shafts
        """Tachometer steps accumulated across sessions and restarts of the controllers."""
        self._last: list[MotorValues | None] = [None] * config.shafts
        self._faults = [0] * config.shafts
        """Reported faults that are still present."""
        self._position: float | None = None
        """Latest position sent to the servo."""

    def _session(self, link: Link) -> VescSession:
        return VescSession(link, self._clock, self._config.answer_timeout)

    async def _start(self, session: VescSession) -> None:
        """See the base class.

        Raises:
            DeviceMismatchError: no controller answers at a CAN id, the firmware is too old, or the watchdog cannot be
                set.
            WrongDeviceError: another device answers.
        """
        config = self._config
        self._position = None
        self._send_all(session, VescSetpoint(DriveMode.QUICK_STOP))
        watchdog = WatchdogSetting(round(1000 * config.watchdog), config.brake_current)
        for i, motor in enumerate(config.motors):
            identity = await session.identify(motor.can_id)
            await session.set_watchdog(motor.can_id, watchdog)
            values = await session.values(motor.can_id, ATTEMPTS)
            last = self._last[i]
            if last is None or step(last.tachometer_abs, values.tachometer_abs) < 0:
                self._last[i] = values  # it has restarted, and counts from 0
            where = "" if motor.can_id is None else f" at CAN id {motor.can_id}"
            text = f"{identity.hardware}{where}, firmware {identity.major}.{identity.minor:02}"
            self._events(Reason.DEVICE_READY, Severity.INFO, self.name, text)

    def _setpoint(self) -> VescSetpoint:
        return setpoint_of(self._latest(), self._clock.now(), self._config)

    def _wanted(self) -> DriveMode:
        return self._setpoint().mode

    async def _exchange(self, session: VescSession) -> None:
        self._send_all(session, self._setpoint())
        for i in range(self._config.shafts):
            await self._read(session, i)

    def _send_all(self, session: VescSession, setpoint: VescSetpoint) -> None:
        """Send the set-points of all motors and of the servo together."""
        self._sent = setpoint.mode
        for i, motor in enumerate(self._config.motors):
            session.send(motor.can_id, payload_of(setpoint, i, self._config))
        servo, command = self._config.servo, self._steering_commands.latest
        if servo is None or self._steering is None or command is None:
            return
        if self._clock.now() - command.stamp <= self._config.command_timeout * SECOND:
            self._position = round(servo.position(command.front_servo), 3)
        if self._position is not None:
            session.send(None, set_servo(self._position))

    async def _read(self, session: VescSession, i: int) -> None:
        values = await session.values(self._config.motors[i].can_id)
        received = self._clock.now()
        stamp = (session.asked + received) // 2
        self._count(i, values)
        self._report_fault(i, values.fault)
        self._publish(i, values, stamp, received)
        if i == 0:
            self._publish_steering(stamp, received)
            if self._battery is not None and received >= self._battery_due:
                self._battery_due = received + round(SECOND / self._config.battery_rate)
                self._battery.take(stamp, received, values.volts, at_limit=False)

    def _count(self, i: int, values: MotorValues) -> None:
        """Accumulate the motor's steps.

        Raises:
            DeviceRestartedError: the controller restarted and counts from 0.
        """
        last = self._last[i]
        self._last[i] = values
        if last is None:
            return
        if step(last.tachometer_abs, values.tachometer_abs) < 0:
            text = f"{self._port.name}: the controller of motor {i + 1} restarted"
            self._events(Reason.DEVICE_RESTARTED, Severity.WARNING, self.name, text)
            raise DeviceRestartedError(text)
        self._ticks[i] += step(last.tachometer, values.tachometer)

    def _report_fault(self, i: int, fault: int) -> None:
        if fault == self._faults[i]:
            return
        self._faults[i] = fault
        if fault:
            text = f"motor {i + 1}: fault {fault_text(fault)}"
            self._events(Reason.DRIVE_FAULT, Severity.ERROR, self.name, text, code=fault)
        else:
            self._events(Reason.DEVICE_READY, Severity.INFO, self.name, f"motor {i + 1}: the fault has cleared")

    def _publish(self, i: int, values: MotorValues, stamp: int, received: int) -> None:
        config, out = self._config, self._outs[i]
        sign = -1 if config.motors[i].inverted else 1
        turn = math.tau / (TICKS_PER_ELECTRICAL_TURN * config.pole_pairs)
        out.put(
            DriveFeedback(
                stamp=stamp,
                received=received,
                seq=out.next_seq(),
                position=sign * self._ticks[i] * turn,
                velocity=sign * values.erpm / config.pole_pairs * RAD_S_PER_RPM,
                current=sign * values.motor_current,
                mode=DriveMode.FAULT if values.fault else self._sent,
                fault_code=values.fault or None,
                supply_voltage=values.volts,
            )
        )

    def _publish_steering(self, stamp: int, received: int) -> None:
        servo, out = self._config.servo, self._steering
        if servo is None or out is None or self._position is None:
            return
        angle = servo.angle(self._position)
        out.put(SteeringFeedback(stamp=stamp, received=received, seq=out.next_seq(), front=angle, rear=0.0))

    async def _make_safe(self, session: VescSession) -> None:
        """Brake until the motors are at rest, then let them coast; after the deadline, the watchdog brakes."""
        config = self._config
        rest = config.standstill_rpm * config.pole_pairs
        with contextlib.suppress(DeviceLostError):
            self._send_all(session, VescSetpoint(DriveMode.QUICK_STOP))
        with contextlib.suppress(DeviceError, TimeoutError):
            async with self._clock.deadline(0.4):  # seconds a session may take at its end to stop the motors
                while True:
                    self._send_all(session, VescSetpoint(DriveMode.QUICK_STOP))
                    speeds = [abs((await session.values(motor.can_id, ATTEMPTS)).erpm) for motor in config.motors]
                    if max(speeds) <= rest:
                        break
                    await self._clock.sleep(1.0 / config.rate)
                self._send_all(session, VescSetpoint(DriveMode.DISABLED))
