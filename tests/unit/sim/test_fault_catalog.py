"""The faults that robots with sonars, with stepper motors and with encoders can have."""

from pathlib import Path

import numpy as np
import pytest

from monstertruck_drivers.epos.exchange import BRIEF_SILENCES
from monstertruck_runtime.clock import SECOND, run_virtual
from monstertruck_sim.faults import SHORT_WRITES, FaultCatalog, FaultKind, apply
from monstertruckd.config.load import load_config
from monstertruckd.tools.drill.random_drill import unguarded
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

ROBOTS = Path(__file__).resolve().parents[3] / "configs" / "robots"
SONARS = {FaultKind.DEAD_SONAR, FaultKind.STUCK_SONAR, FaultKind.CROSS_TALK, FaultKind.WRONG_SIGN, FaultKind.FROZEN}
WHEELS = {FaultKind.BAD_ANSWERS, FaultKind.HELD_WHEEL, FaultKind.LATE_ANSWERS}

ENCODERS = {FaultKind.STUCK_ENCODER, FaultKind.MIRRORED_ENCODER, FaultKind.FROZEN}


LASTING = {FaultKind.HUB_LOSS, FaultKind.RAIL_ELECTRONICS, FaultKind.LOOP_STALL}
"""Their ends take time, or a daemon."""


def loaded(name):
    return load_config(ROBOTS / f"{name}.yaml", SimulatedTruckConfig)[0]


def only(catalog, kind, seed=1):
    return catalog.draw(np.random.default_rng(seed), without=frozenset(catalog.kinds) - {kind})


@pytest.mark.parametrize(("name", "kinds"), [("sonar", SONARS), ("skid_stand", WHEELS), ("tricycle", ENCODERS)])
def test_a_robot_has_the_faults_of_its_devices(name, kinds):
    config = loaded(name)
    catalog = FaultCatalog(config.devices, records=False)
    assert kinds <= set(catalog.kinds)
    assert not (SONARS | WHEELS) - kinds & set(catalog.kinds) - {FaultKind.LATE_ANSWERS}


@pytest.mark.parametrize("name", sorted(path.stem for path in ROBOTS.glob("*.yaml")))
def test_the_emulators_of_each_robot_know_the_faults_that_are_drawn(name):
    config = loaded(name)
    catalog = FaultCatalog(config.devices, records=False)

    async def main(clock):
        rig = VirtualRig(config, clock)
        try:
            for kind in set(catalog.kinds) - LASTING:
                for seed in range(4):
                    fault = only(catalog, kind, seed)
                    await apply(fault.start, rig.context)
                    await apply(fault.end, rig.context)
        finally:
            rig._folder.cleanup()

    run_virtual(main, start=SECOND)


def test_without_sonars_that_guard_it_a_robot_stops_and_with_a_lidar_it_need_not():
    config = loaded("sonar")
    lidar = loaded("differential").devices.lidar
    for devices, stops in ((config.devices, True), (config.devices.model_copy(update={"lidar": lidar}), False)):
        catalog, rng = FaultCatalog(devices, records=False), np.random.default_rng(3)
        unplugged = [catalog.draw(rng, without=frozenset(catalog.kinds) - {FaultKind.UNPLUG}) for _ in range(40)]
        assert {one.must_stop for one in unplugged if one.name == "unplug: sonar"} == {stops}
        assert {one.must_stop for one in unplugged if one.name == "unplug: drive_2"} == {True}
        assert {one.must_stop for one in unplugged if one.name == "unplug: imu"} == {False}


@pytest.mark.parametrize("name", ["turtle", "truck_today", "f1tenth"])
def test_robots_of_todays_devices_have_no_faults_of_steppers(name):
    kinds = FaultCatalog(loaded(name).devices, records=False).kinds
    assert FaultKind.UNPLUG in kinds
    assert not WHEELS & set(kinds) - {FaultKind.LATE_ANSWERS}


@pytest.mark.parametrize(("name", "role", "left"), [("f1tenth", "actuators", ()), ("donkeycar", None, ("actuators",))])
def test_a_controller_of_all_shafts_has_the_faults_of_its_line(name, role, left):
    """A PCA9685 is on no serial line, and nothing stops its last pulses."""
    config = loaded(name)
    assert unguarded(config) == left
    catalog = FaultCatalog(config.devices, records=False, unguarded=left)
    drawn = [catalog.draw(np.random.default_rng(seed)) for seed in range(200)]
    assert ({FaultKind.GARBAGE, FaultKind.STALL, FaultKind.RESET} <= set(catalog.kinds)) is (role is not None)
    assert any(one.name == "unplug: actuators" and one.must_stop for one in drawn) is (role is not None)


def test_cross_talk_is_an_echo_from_where_nothing_is():
    config = loaded("sonar")

    async def hear(clock):
        rig = VirtualRig(config, clock)
        try:
            fault = only(FaultCatalog(config.devices, records=False), FaultKind.CROSS_TALK)
            await apply(fault.start, rig.context)
            modules = rig.robot.emulators["sonar"].modules.values()
            (ghost,) = [one.ghost for one in modules if one.ghost is not None]
            await apply(fault.end, rig.context)
            return ghost, [one.ghost for one in modules], fault.name
        finally:
            rig._folder.cleanup()

    ghost, after, name = run_virtual(hear, start=SECOND)
    assert set(after) == {None}
    assert ghost * 343.0 / 2e6 == pytest.approx(float(name.split(", ")[1].removesuffix(" m")), abs=0.01)


def test_short_writes_do_not_cut_off_a_controller_that_nothing_stops():
    config = loaded("sonar")
    catalog = FaultCatalog(config.devices, records=False, unguarded=("drive", "drive_2"))

    async def drawn(clock):
        rig, most = VirtualRig(config, clock), dict.fromkeys(("drive", "drive_2", "sonar", "imu"), 0)
        try:
            for seed in range(300):
                fault = only(catalog, FaultKind.SHORT_WRITE, seed)
                role = fault.name.rpartition(" ")[2]
                await apply(fault.start, rig.context)
                most[role] = max(most[role], rig.ports[role].device.faults.short_writes)
                await apply(fault.end, rig.context)
            return most
        finally:
            rig._folder.cleanup()

    most = run_virtual(drawn, start=SECOND)
    assert most == {"drive": BRIEF_SILENCES, "drive_2": BRIEF_SILENCES, "sonar": SHORT_WRITES, "imu": SHORT_WRITES}
