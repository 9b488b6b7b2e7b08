"""Emulated VESCs: the connected controller and the controllers behind it on its CAN bus.

Real VESCs send nothing without a request, and do not answer damaged packets, unknown packets or set-points. When
set-points stop, the watchdog applies its brake current; the factory setting is 0, so the motor coasts freely. The speed
controller gives no torque below its minimum speed. A fault releases the motor for half a second. Answers from
controllers on the CAN bus do not name their sender. Temporary settings and counters are lost at power-up. The servo
output keeps its latest position.
"""

import asyncio
from functools import partial
from typing import Final

import numpy as np

from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.disobedience import USAGE, DisobedientMotor
from monstertruck_drivers.emulation import EmulatorSetup, MotorPlant, ReceivedBytes, ServoPlant
from monstertruck_drivers.epos.firmware import FreeMotor
from monstertruck_drivers.fault_table import FaultTable, FaultyDevice, LateAnswers
from monstertruck_drivers.signals import SignalKind, Signals
from monstertruck_drivers.vesc.config import VescConfig
from monstertruck_drivers.vesc.protocol import (
    SERVO_SCALE,
    TICKS_PER_ELECTRICAL_TURN,
    VESC_BAUD,
    Deframer,
    FirmwareIdentity,
    MotorValues,
    PacketId,
    WatchdogSetting,
    frame,
    wrapped,
)
from monstertruck_runtime.clock import MILLISECOND, SECOND, Clock

FACTORY: Final = WatchdogSetting(1000, 0.0)
"""Factory setting of the watchdog."""
SETTINGS_SIZE: Final = 480
"""Size of the answer with the settings (bytes)."""
SIGNATURE: Final = bytes.fromhex("7d21b4f8")
"""Start of the settings; any number is valid, because the host returns it."""
NO_LOAD_PER_VOLT: Final = 400.0
"""No-load speed per volt at full duty (rpm/V)."""
HARDWARE: Final = "60"


class EmulatedController:
    """One controller with its motor.

    Args:
        now: clock.
        plant: motor load.
        settings: driver settings: pole pairs, braking.
        can_id: this controller's CAN id.
        signals: signals of the complete device.
        place: motor number, counted from 1, for the signal names.
    """

    def __init__(
        self, clock: Clock, plant: MotorPlant, settings: VescConfig, can_id: int, signals: Signals, place: int
    ) -> None:
        self.can_id = can_id
        self.runaway: DisobedientMotor | None = None
        self.fault = 0
        self._clock = clock
        self._plant = plant
        self._config = settings
        self._signals = signals
        self._place = place
        self._tail = bytes(SETTINGS_SIZE - len(SIGNATURE) - 9)
        self.restart()

    def restart(self) -> None:
        """Restart as after power-up: coasting, counters at 0, factory watchdog."""
        now = self._clock.now()
        self.watchdog = FACTORY
        self.timed_out = False
        self._fed = now
        self._blocked_until = 0
        self._origin = self._turns(now)
        self._travel, self._seen = 0.0, self._origin
        self._turn(None)

    def feed(self) -> None:
        """Record a set-point, which resets the watchdog."""
        self._fed, self.timed_out = self._clock.now(), False

    def watch(self) -> None:
        """Brake if set-points have stopped; see ``timeout.c``."""
        limit = self.watchdog.milliseconds
        if limit and self._clock.now() - self._fed > limit * MILLISECOND:
            self.timed_out = True
            self.brake(self.watchdog.brake_current)

    def fail(self, code: int) -> None:
        """Start a fault: the motor coasts, and set-points are ignored for a while; 0 ends a permanent fault."""
        self.fault = code
        fault_stop = 500 * MILLISECOND  # time after a fault in which the controller ignores set-points
        self._blocked_until = self._clock.now() + fault_stop
        self._turn(None)

    def run(self, erpm: float) -> None:
        """Hold an electrical speed; below the minimum speed there is no torque."""
        rpm = erpm / self._config.pole_pairs
        slow = abs(rpm) < self._config.min_motor_rpm
        self._turn(None if slow else rpm, self._config.deceleration_rpm_s)

    def brake(self, amperes: float) -> None:
        """Brake with a current."""
        share = amperes / self._config.brake_current
        deceleration = share * self._config.quick_stop_deceleration_rpm_s
        self._turn(0.0 if amperes > 0 else None, deceleration or 1.0)

    def drive(self, amperes: float) -> None:
        """Drive with a current; 0 lets the motor coast."""
        share = abs(amperes) / self._config.brake_current
        free = NO_LOAD_PER_VOLT * self._plant.reading(self._clock.now()).supply_v
        target = None if amperes == 0.0 else (free if amperes > 0 else -free)
        self._turn(target, share * self._config.quick_stop_deceleration_rpm_s or 1.0)

    def duty(self, share: float) -> None:
        """Run at a fraction of the speed that the supply allows."""
        free = NO_LOAD_PER_VOLT * self._plant.reading(self._clock.now()).supply_v
        self._turn(share * free, self._config.deceleration_rpm_s)

    def obey_again(self) -> None:
        """Apply the start or end of a disobedience to the current target."""
        self._turn(*self._asked)

    def settings(self) -> bytes:
        """Answer to ``GET_APPCONF``."""
        watchdog = self.watchdog.applied(bytes(15))[6:14]
        return bytes((PacketId.GET_APPCONF,)) + SIGNATURE + bytes((self.can_id,)) + watchdog + self._tail

    def apply(self, payload: bytes) -> bool:
        """Apply temporary settings; return False if their signature belongs to another firmware."""
        if payload[1:5] != SIGNATURE or len(payload) < SETTINGS_SIZE:
            return False
        self.watchdog = WatchdogSetting.of(bytes((PacketId.GET_APPCONF,)) + payload[1:])
        return True

    def values(self) -> MotorValues:
        """Current values as sent to the host."""
        now, report, n = self._clock.now(), self._signals.report, self._place
        reading, turns = self._plant.reading(now), self._turns(now)
        self._travel += abs(turns - self._seen)
        self._seen = turns
        ticks = TICKS_PER_ELECTRICAL_TURN * self._config.pole_pairs
        erpm = round(reading.rpm * self._config.pole_pairs)
        free = NO_LOAD_PER_VOLT * max(reading.supply_v, 1.0)
        return MotorValues(
            motor_current=_limited(report(f"current_{n}", reading.current_ma / 1000), 1e6),
            duty=max(-1.0, min(1.0, reading.rpm / free)),
            erpm=round(_limited(report(f"erpm_{n}", erpm), 1e9)),
            volts=_limited(report(f"volts_{n}", reading.supply_v), 3000.0),
            tachometer=wrapped(report(f"tachometer_{n}", int((turns - self._origin) * ticks // 1))),
            tachometer_abs=wrapped(int(self._travel * ticks)),
            fault=self.fault,
            controller_id=self.can_id,
            timed_out=self.timed_out,
        )

    def _turns(self, now: int) -> float:
        return self._plant.reading(now).turns

    def _turn(self, rpm: float | None, acceleration: float = 1.0) -> None:
        """Command a speed; None lets the motor coast."""
        self._asked = rpm, acceleration
        now = self._clock.now()
        if self.fault or now < self._blocked_until:
            rpm = None
        if self.runaway is not None:
            rpm = self.runaway.target(rpm, self._plant.reading(now).rpm)
        self._plant.command(now, rpm, acceleration)


class VescEmulator(FaultyDevice):
    """All controllers on one port.

    Faults (``inject``): ``silent on|off`` (no answers), ``late SECONDS [COUNT]`` (late answers), ``noise COUNT`` (the
    next COUNT answers contain a wrong byte), ``reset`` (all restart), ``fault CODE [MOTOR]`` (0 ends it), ``no_store
    on|off`` (firmware without temporary settings), ``firmware MAJOR MINOR``, ``runaway`` (all disobey, see
    ``DisobedientMotor``).

    Args:
        clock: time.
        plants: motor loads; missing entries are replaced by unloaded motors.
        servos: steering servos; the output moves the servo on channel 0. None if not connected.
        settings: list of controllers.
        own_id: CAN id of the connected controller.
    """

    def __init__(
        self,
        clock: Clock,
        plants: tuple[MotorPlant, ...] = (),
        servos: ServoPlant | None = None,
        settings: VescConfig | None = None,
        *,
        own_id: int = 100,
    ) -> None:
        self.name = "vesc"
        self.received = ReceivedBytes()
        """Latest bytes from the host."""
        config = settings or VescConfig()
        count = config.shafts
        reported, ordered = ("erpm", "tachometer", "current", "volts"), ("run", "stop")
        kinds = {f"{what}_{n}": SignalKind.NUMBER for n in range(1, count + 1) for what in reported}
        kinds |= {f"{what}_{n}": SignalKind.ORDER for n in range(1, count + 1) for what in ordered}
        kinds["servo"] = SignalKind.ORDER
        self.signals = Signals(clock.now, kinds, np.random.default_rng(0))
        self.position: float | None = None
        """Position of the servo output; None: no pulses yet."""
        self._clock = clock
        self._servos = servos
        self._late = LateAnswers()
        self.faults = FaultTable(
            self.name,
            {
                "silent|no_store on|off": False,
                "late SECONDS [COUNT]": self._late.start,
                "noise COUNT": 0,
                "reset": self.power_cycle,
                "fault CODE [MOTOR]": self._fail,
                "firmware MAJOR MINOR": self._set_version,
                f"runaway {USAGE}": self._run_away,
            },
        )
        self._version = (6, 5)
        self._awake_at = 0
        self._deframer = Deframer()
        places = [*plants, *(FreeMotor() for _ in range(count - len(plants)))][:count]
        self.controllers = [
            EmulatedController(clock, plant, config, own_id if motor.can_id is None else motor.can_id, self.signals, n)
            for n, (plant, motor) in enumerate(zip(places, config.motors, strict=True), 1)
        ]
        self._by_id = {controller.can_id: controller for controller in self.controllers}
        self._own = self._by_id.get(own_id)
        if servos is not None:
            servos.attach(self)

    def pulse_us(self, channel: int, time_ns: int) -> float | None:
        """Pulse at the servo output, which is channel 0 (us); see ``PulseSource``."""
        del time_ns
        if channel != 0 or self.position is None:
            return None
        servo_pulses = (1000.0, 2000.0)  # pulses of the positions 0 and 1, us
        low, high = servo_pulses
        return low + self.position * (high - low)

    def power_cycle(self) -> None:
        """Switch the supply off and on: all controllers restart."""
        if self._servos is not None:
            self._servos.advance(self._clock.now())
        boot = 500 * MILLISECOND  # from power-up to the first answer
        self._awake_at = self._clock.now() + boot
        self.position = None
        self._deframer.restart()
        for controller in self.controllers:
            controller.restart()

    def _fail(self, code: str, motor: str = "1") -> None:
        self.controllers[int(motor) - 1].fail(int(code))

    def _set_version(self, major: str, minor: str) -> None:
        self._version = int(major), int(minor)

    def _run_away(self, *words: str) -> None:
        runaway = DisobedientMotor.parse(*words)
        for controller in self.controllers:
            controller.runaway = runaway
            controller.obey_again()

    async def run(self, end: DeviceEnd) -> None:
        """Serve until cancelled."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._watch())
            while True:
                data = await end.read()
                self.received.extend(data)
                if self._clock.now() < self._awake_at:
                    continue
                for payload in self._deframer.feed(data):
                    self._take(end, payload)

    async def _watch(self) -> None:
        watch_period = 10 * MILLISECOND  # period of the watchdog's checks
        while True:
            await self._clock.sleep(watch_period / SECOND)
            for controller in self.controllers:
                controller.watch()

    def _take(self, end: DeviceEnd, payload: bytes) -> None:
        controller, delay = self._own, 0.0005  # seconds from the end of a request to its answer
        if payload[0] == PacketId.FORWARD_CAN and len(payload) > 2:
            # Round trip of an answer of some 80 bytes in frames of 8 bytes at 500 kbit/s (s).
            can_delay = 0.003
            controller, delay = self._by_id.get(payload[1]), can_delay
            payload = payload[2:]
        if payload[0] == PacketId.SET_SERVO_POS and len(payload) == 3:
            self._set_servo(int.from_bytes(payload[1:], "big", signed=True) / SERVO_SCALE)
        elif controller is not None and (answer := self._obey(controller, payload)) is not None:
            restart_of_apps = 0.05  # delay of the answer after a change of settings (s)
            late = restart_of_apps if payload[0] == PacketId.SET_APPCONF_NO_STORE else 0.0
            self._send(end, answer, delay + late)

    def _set_servo(self, position: float) -> None:
        def move(position: float) -> None:
            if self._servos is not None:
                self._servos.advance(self._clock.now())
            self.position = max(0.0, min(1.0, position))

        self.signals.order("servo", position, move)

    def _obey(self, controller: EmulatedController, payload: bytes) -> bytes | None:
        """Execute a payload; return the answer, if any."""
        match payload[0]:
            case PacketId.FW_VERSION:
                serial = bytes((controller.can_id,)) * 12
                return FirmwareIdentity(*self._version, HARDWARE, serial).payload()
            case PacketId.GET_VALUES:
                return controller.values().payload()
            case PacketId.GET_APPCONF:
                return controller.settings()
            case PacketId.SET_APPCONF_NO_STORE:
                taken = not self.faults["no_store"] and controller.apply(payload)
                return bytes((PacketId.SET_APPCONF_NO_STORE,)) if taken else None
            case PacketId.ALIVE:
                controller.feed()
            case number if len(payload) == 5:
                self._set(controller, number, int.from_bytes(payload[1:], "big", signed=True))
        return None

    def _set(self, controller: EmulatedController, number: int, value: int) -> None:
        """Execute a set-point."""
        place = self.controllers.index(controller) + 1
        order = partial(self.signals.order, f"run_{place}")
        match number:
            case PacketId.SET_RPM:
                order(float(value), controller.run)
            case PacketId.SET_DUTY:
                controller.duty(value / 100_000)
            case PacketId.SET_CURRENT:
                controller.drive(value / 1000)
            case PacketId.SET_CURRENT_BRAKE:
                self.signals.order(f"stop_{place}", value / 1000, controller.brake)
            case _:
                return
        controller.feed()

    def _send(self, end: DeviceEnd, answer: bytes, delay: float) -> None:
        if self.faults["silent"]:
            return
        data = frame(answer)
        if self.faults.strikes("noise"):
            data = data[:-4] + bytes((data[-4] ^ 0x10,)) + data[-3:]
        end.write(data, self._late.take(delay))


def _limited(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))


def emulated(setup: EmulatorSetup) -> VescEmulator:
    """Create the controllers of a simulated robot; the servo output moves the servo on channel 0."""
    settings: VescConfig = setup.settings or VescConfig()
    setup.port.device.baud = VESC_BAUD
    servos = None if settings.servo is None else setup.physics.servos
    return VescEmulator(setup.clock, setup.physics.motors[: settings.shafts], servos, settings)
