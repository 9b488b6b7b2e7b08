"""Families of faults: generated from the signals of whatever devices a robot has."""

from pathlib import Path

import numpy as np
import pytest

from monstertruck_drivers.epos import objects as od
from monstertruck_drivers.epos.firmware import Firmware, FreeMotor
from monstertruck_drivers.epos.protocol import Control, State
from monstertruck_drivers.signals import FAULTS, REPORTS, SignalKind
from monstertruck_runtime.clock import SECOND, run_virtual
from monstertruck_runtime.errors import InputError
from monstertruck_sim.families import ARGUMENTS, MESSAGE, MESSAGES, families
from monstertruck_sim.faults import apply
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from monstertruckd.tools.simulation.virtual_rig import VirtualRig
from tests.long_kit import mostly_long

CONFIGS = Path(__file__).resolve().parents[3] / "configs"
UNUSED = {
    *("velocity_demand", "velocity_actual", "current_averaged"),
    *("error_register", "number_of_errors", "digital_input_state"),
}
"""Objects of the EPOS that the driver does not read while all is well."""
ROBOTS = ("full", "robots/sonar", "robots/skid_stand", "robots/tricycle", "robots/mecanum")


def loaded(name):
    return load_config(CONFIGS / f"{name}.yaml", SimulatedTruckConfig)[0]


def on_rig(name, test):
    async def main(clock):
        async with VirtualRig(loaded(name), clock).running() as rig:
            await clock.sleep(5.0)
            await test(rig, clock)

    run_virtual(main, start=SECOND)


def test_every_fault_that_takes_an_argument_is_drawn_one():
    assert ARGUMENTS.keys() == {name for name, fault in FAULTS.items() if fault.argument}


@pytest.mark.parametrize("name", mostly_long(ROBOTS, {"full", "robots/sonar", "robots/skid_stand"}))
def test_every_family_of_a_robot_begins_and_ends_and_every_signal_is_a_real_one(name):
    async def test(rig, clock):
        context, rng = rig.context, np.random.default_rng(1)
        found = families(rig.robot)
        assert len({family.name for family in found}) == len(found)
        assert {f.role for f in found if f.signal == MESSAGE} == set(rig.robot.emulators)
        assert {f.role for f in found if f.signal != MESSAGE} >= set(rig.robot.emulators)
        for family in found:
            fault = family.draw(rng, 1.0)
            await apply(fault.start, context)
            await apply(fault.end, context)
        for role, emulator in rig.robot.emulators.items():
            line, signals = context.device(role).port.device.faults, emulator.signals
            assert not any(getattr(line, fault) for fault in MESSAGES)
            silent = {name for name, kind in signals.kinds.items() if kind in REPORTS and not signals.used(name)}
            silent = {name for name in silent if not name.startswith("position_")}  # of servos, which nobody asks for
            assert silent <= UNUSED, f"{role} never reports {silent}"

    on_rig(name, test)


def test_a_message_family_falsifies_the_line_and_a_signal_family_only_its_signal():
    async def test(rig, clock):
        context = rig.context
        lose = next(f for f in families(rig.robot) if (f.role, f.fault) == ("compass", "lose_rate"))
        fault = lose.draw(np.random.default_rng(3), 1.0)
        await apply(fault.start, context)
        assert 0 < context.device("compass").port.device.faults.lose_rate < 1
        assert context.device("lidar").port.device.faults.lose_rate == 0
        await apply(fault.end, context)

    on_rig("full", test)


def test_a_robot_without_the_device_refuses():
    async def test(rig, clock):
        with pytest.raises(InputError, match="names no signals"):
            rig.context.signals("wheels")

    on_rig("full", test)


@pytest.mark.parametrize(
    ("ignored", "moves"),
    [
        ((), False),
        (("target_velocity",), False),
        (("target_velocity", "quick_stop"), False),
        (("target_velocity", "quick_stop", "disable_voltage"), True),
    ],
)
def test_an_epos_obeys_each_order_that_it_does_not_ignore(ignored, moves):
    seconds = 0.0

    def now():
        return round(seconds * SECOND)

    def write(entry, value):
        firmware.write(entry.index, entry.sub, entry.encode(value))

    firmware = Firmware(now, motor := FreeMotor(), np.random.default_rng(1))
    write(od.MODE, od.PROFILE_VELOCITY)
    for control in (Control.SHUTDOWN, Control.SWITCH_ON, Control.ENABLE):
        write(od.CONTROLWORD, control)
        seconds += 0.5
        firmware.advance()
    assert firmware.state is State.ENABLED
    write(od.TARGET_VELOCITY, 3000)
    seconds += 1.0
    for name in ignored:
        firmware.signals.inject(name, "ignored")
    write(od.TARGET_VELOCITY, 0)
    write(od.CONTROLWORD, Control.QUICK_STOP)
    write(od.CONTROLWORD, Control.DISABLE_VOLTAGE)
    seconds += 2.0
    assert (abs(motor.reading(now()).rpm) > 1000) is moves


def test_the_deadman_line_stops_an_epos_that_ignores_every_order():
    seconds = 0.0

    def now():
        return round(seconds * SECOND)

    firmware = Firmware(now, motor := FreeMotor(), np.random.default_rng(1))
    firmware.state = State.ENABLED
    motor.command(0, 3000.0, 1e6)
    for name, kind in firmware.signals.kinds.items():
        if kind in (SignalKind.ORDER, SignalKind.SWITCH):
            firmware.signals.inject(name, "ignored")
    seconds = 0.5
    firmware.set_quick_stop_input(True)
    seconds = 3.0
    assert motor.reading(now()).rpm == 0
