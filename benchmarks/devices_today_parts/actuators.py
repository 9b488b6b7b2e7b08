"""Rows of the motor controllers."""

import math
from collections.abc import Callable
from typing import Any

from benchmarks.devices_today_parts.kit import Bench, Newest, on_bench, running, score, stranger_refused, survived
from monstertruck_drivers.arduino_bridge.config import ArduinoBridgeConfig
from monstertruck_drivers.arduino_bridge.driver import ArduinoBridgeDriver
from monstertruck_drivers.arduino_bridge.emulator import ArduinoBridgeEmulator
from monstertruck_drivers.epos.firmware import FreeMotor
from monstertruck_drivers.maestro.esc_config import MaestroEscConfig
from monstertruck_drivers.maestro.esc_driver import MaestroEscDriver
from monstertruck_drivers.maestro.esc_emulator import MaestroEscEmulator
from monstertruck_drivers.pca9685.config import Pca9685EscConfig
from monstertruck_drivers.pca9685.emulator import Pca9685EscEmulator
from monstertruck_drivers.pca9685.esc_driver import Pca9685EscDriver
from monstertruck_drivers.vesc.config import VescConfig, VescMotorConfig
from monstertruck_drivers.vesc.driver import VescDriver
from monstertruck_drivers.vesc.emulator import VescEmulator
from monstertruck_runtime.clock import SECOND, VirtualClock
from monstertruck_runtime.mailbox import Mailbox, latest
from monstertruck_schemas.cmd import DriveAction, DriveCommand, SteeringCommand
from monstertruck_schemas.sensor import DriveFeedback

NAMES = ("", "_2", "_3", "_4")
RPM = math.tau / 60
TRIES = 20


class DriveBench(Bench):
    """Motors commanded 50 times a second.

    Args:
        clock: source of time.
        emulator: creates the emulated controller of two rotors.
        driver: creates the driver from port, events and the ends of its topics.
        rate: commanded rate, rad/s.
        motors: number of motors of the controller.
    """

    def __init__(
        self,
        clock: VirtualClock,
        emulator: Callable[[tuple[FreeMotor, ...]], Any],
        driver: Callable[..., Any],
        rate: float,
        motors: int = 2,
    ) -> None:
        self.rotors = tuple(FreeMotor() for _ in range(motors))
        self.steering: Mailbox[SteeringCommand] = Mailbox(latest(), lambda _: None)
        self.rate = rate
        self.commands: list[Mailbox[DriveCommand]] = [Mailbox(latest(), lambda _: None) for _ in NAMES]
        self.outs: list[Newest[DriveFeedback]] = [Newest() for _ in NAMES]
        ends: dict[str, Any] = {f"commands{n}": box for n, box in zip(NAMES, self.commands, strict=True)}
        ends |= {f"out{n}": out for n, out in zip(NAMES, self.outs, strict=True)}
        ends["steering_commands"] = self.steering
        super().__init__(clock, emulator(self.rotors), lambda port, events: driver(port, events, ends))

    async def command(self) -> None:
        """Send a command at every tick of the gate."""
        while True:
            now = self.clock.now()
            for box in self.commands:
                box.put(
                    DriveCommand(
                        stamp=now,
                        received=now,
                        seq=0,
                        action=DriveAction.RUN,
                        speed=0.0,
                        motor_velocity=self.rate,
                    )
                )
            self.steering.put(
                SteeringCommand(stamp=now, received=now, seq=0, front=0.0, rear=0.0, front_servo=0.0, rear_servo=0.0)
            )
            await self.clock.sleep(0.02)

    @property
    def fastest(self) -> float:
        """Speed of the faster rotor, rad/s."""
        return max(abs(rotor.reading(self.clock.now()).rpm) for rotor in self.rotors) * RPM

    def healthy(self) -> bool:
        """Whether both rotors turn as commanded, and the driver reports it."""
        slow = [abs(r.reading(self.clock.now()).rpm * RPM - self.rate) > 0.05 * self.rate for r in self.rotors]
        fresh = all(
            self.clock.now() - out.kept[-1].received < 0.2 * SECOND for out in self.outs[: len(self.rotors)] if out.kept
        )
        return not any(slow) and fresh


async def stand(bench: DriveBench, after: float) -> float:
    """Return the time (ms) from the death of the host to standstill."""
    async with running(bench.command(), bench.serve()):
        await bench.clock.sleep(4.0 + after)
        assert bench.fastest > 0.9 * bench.rate
        bench.port.device.faults.deaf = True
        died = bench.clock.now()
        while bench.fastest > 0.01 * bench.rate:
            await bench.clock.sleep(0.001)
        return (bench.clock.now() - died) / 1e6


async def clock_error(bench: DriveBench) -> float:
    """Return the maximum error of the stamps at a constant speed, ms."""
    async with running(bench.command(), bench.serve()):
        await bench.clock.sleep(5.0)
        first = len(bench.outs[0].kept)
        await bench.clock.sleep(5.0)
        now = bench.clock.now()
        reading = bench.rotors[0].reading(now)
        speed = reading.rpm * RPM
        errors = [
            (reading.turns * math.tau - speed * (now - one.stamp) / SECOND - one.position) / speed
            for one in bench.outs[0].kept[first:]
        ]
        return max(map(abs, errors)) * 1000


STALLS = ("silent on", "silent off"), ("noise 9", "noise 0")


def row(
    make: Callable[[VirtualClock], DriveBench],
    foreign: str,
    stalls: tuple[tuple[str, str], ...] = STALLS,
    *,
    measures: bool = True,
    watched: bool = True,
    talks: bool = True,
) -> dict[str, Any]:
    """Measure one controller.

    Args:
        make: creates the bench.
        foreign: test of another implementation.
        stalls: faults of the emulator, the first of which silences it: commands to start and end each.
        measures: whether it measures its motors.
        watched: whether it detects a dead host.
        talks: whether a device on its port may send unrequested; on an I2C bus none does.
    """
    stands = [on_bench(make, lambda bench, i=i: stand(bench, i * 0.0037)) for i in range(TRIES if watched else 0)]

    async def trouble(bench: DriveBench) -> dict[str, bool]:
        async with running(bench.command(), bench.serve()):
            await bench.clock.sleep(4.0)
            return await survived(bench, bench.healthy, *stalls)

    found = on_bench(make, trouble)

    async def refused(bench: DriveBench) -> bool:
        bench.emulator.inject(*stalls[0][0].split())
        return await stranger_refused(bench)

    if talks:
        found["stranger"] = on_bench(make, refused)
    return {
        "stand_ms": round(max(stands), 1) if stands else None,
        "clock_ms": round(on_bench(make, clock_error), 2) if measures else None,
        "trouble": score(found),
        "foreign": foreign,
    }


def vesc() -> dict[str, Any]:
    """Two controllers, one of them behind CAN, at 2000 rpm."""
    config = VescConfig(motors=(VescMotorConfig(), VescMotorConfig(can_id=7)))

    def driver(clock: VirtualClock) -> Callable[..., Any]:
        def make(port: Any, events: Any, ends: dict[str, Any]) -> VescDriver:
            none: Any = Mailbox(latest(), lambda _: None)
            return VescDriver(
                config,
                port,
                clock,
                drive=none,
                steering=None,
                battery=None,
                events=events,
                **ends,
            )

        return make

    return row(
        lambda clock: DriveBench(
            clock, lambda rotors: VescEmulator(clock, rotors, None, config), driver(clock), 2000 * RPM
        ),
        "tests/unit/drivers/vesc/test_third_party.py",
    )


def arduino_bridge() -> dict[str, Any]:
    """A board whose firmware was compiled with an auto-stop of 200 ms, at 2 rad/s."""
    config = ArduinoBridgeConfig(auto_stop=0.2)

    def driver(clock: VirtualClock) -> Callable[..., Any]:
        def make(port: Any, events: Any, ends: dict[str, Any]) -> ArduinoBridgeDriver:
            ends.pop("steering_commands")
            return ArduinoBridgeDriver(config, port, clock, events=events, **ends)

        return make

    rate = 8 * config.pid_rate * config.turn
    return row(
        lambda clock: DriveBench(
            clock, lambda rotors: ArduinoBridgeEmulator(clock, rotors, config), driver(clock), rate
        ),
        "none found as a package",
    )


def maestro_esc() -> dict[str, Any]:
    """A speed controller without feedback on a Maestro with a serial time-out of 0.2 s, at 40 rad/s."""
    config = MaestroEscConfig()

    def make(clock: VirtualClock) -> DriveBench:
        def driver(port: Any, events: Any, ends: dict[str, Any]) -> MaestroEscDriver:
            none: Any = Mailbox(latest(), lambda _: None)
            out: Any = Newest()
            return MaestroEscDriver(
                config,
                port,
                clock,
                drive=none,
                steering=out,
                battery=None,
                events=events,
                **ends,
            )

        return DriveBench(
            clock, lambda rotors: MaestroEscEmulator(clock, rotors[0], None, config), driver, 40.0, motors=1
        )

    stalls = (("mute on", "mute off"), ("mode uart", "mode dual_port"), ("brown_out 0.5", "error 3"))
    return row(make, "none: its protocol has no client in use here", stalls, measures=False)


def pca9685_esc() -> dict[str, Any]:
    """A speed controller without feedback on a PCA9685, which has no watchdog, at 40 rad/s."""
    config = Pca9685EscConfig()

    def make(clock: VirtualClock) -> DriveBench:
        def driver(port: Any, events: Any, ends: dict[str, Any]) -> Pca9685EscDriver:
            none: Any = Mailbox(latest(), lambda _: None)
            out: Any = Newest()
            return Pca9685EscDriver(config, port, clock, drive=none, steering=out, battery=None, events=events, **ends)

        return DriveBench(
            clock, lambda rotors: Pca9685EscEmulator(clock, rotors[0], None, config), driver, 40.0, motors=1
        )

    stalls = (("absent on", "absent off"), ("brown_out", "oscillator 25e6"))
    foreign = "tests/unit/drivers/pca9685/test_emulator.py"
    return row(make, foreign, stalls, measures=False, watched=False, talks=False)


ROWS = {"maestro_esc": maestro_esc, "pca9685_esc": pca9685_esc, "vesc": vesc, "arduino_bridge": arduino_bridge}
