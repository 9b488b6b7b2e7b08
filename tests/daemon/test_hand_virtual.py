"""A truck driven by a radio control, emulated whole: arm switch, sticks, loss of the transmitter in full drive."""

from pathlib import Path

import pytest

from monstertruck_drivers.receiver.emulator import ReceiverEmulator
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import RequestRefusedError
from monstertruck_runtime.mailbox import latest
from monstertruck_schemas import topics
from monstertruck_schemas.req import Order, Role
from monstertruck_schemas.state import GateMode
from monstertruckd.config.load import load_config
from monstertruckd.gate.hand import MOBILE
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(120)]

TRUCK = Path(__file__).resolve().parents[2] / "configs" / "robots" / "truck.yaml"
WITH_HAND = "include: {truck}\nversion: 2\ndevices:\n  hand: {{ driver: {{ kind: {kind}, estop: 6 }} }}\n"
STICK, ARM, ESTOP = 2, 5, 6


def on_truck(test, folder: Path, kind: str) -> None:
    file = folder / "truck.yaml"
    file.write_text(WITH_HAND.format(truck=TRUCK, kind=kind))
    config, _ = load_config(file, SimulatedTruckConfig)
    config = config.model_copy(update={"recorder": None, "path": None, "tracker": None})

    async def main(clock: VirtualClock) -> None:
        rig = VirtualRig(config, clock)
        with rig.bus.subscribe(topics.GATE, latest()) as gate:
            async with rig.running():
                await clock.sleep(3.0)
                receiver = rig.robot.emulators["hand"]
                assert isinstance(receiver, ReceiverEmulator)
                await test(rig, clock, receiver, gate)

    run_virtual(main, start=SECOND)


@pytest.mark.parametrize("kind", ["crsf", "sbus"])
@pytest.mark.parametrize(
    "lose",
    [
        lambda rig, receiver: receiver.inject("transmitter", "off"),
        lambda rig, receiver: rig.robot.ports["hand"].unplug(),
        lambda rig, receiver: receiver.move(ARM, -1.0),
    ],
    ids=["transmitter off", "unplugged", "switched off"],
)
def test_it_arms_drives_and_stands_when_the_hand_is_gone(tmp_path: Path, kind: str, lose):
    async def test(rig, clock, receiver, gate):
        assert gate.latest.mode is GateMode.DISARMED
        receiver.move(ARM, 1.0)
        await clock.sleep(0.5)
        assert gate.latest.mode in MOBILE
        receiver.move(STICK, 1.0)
        await clock.sleep(2.0)
        assert rig.world.truth(clock.now()).v > 0.15
        assert (gate.latest.mode, gate.latest.holder, gate.latest.role) == (GateMode.DRIVING, "hand", Role.HAND)
        lose(rig, receiver)
        lost_at = clock.now()
        while abs(rig.world.truth(clock.now()).v) > rig.config.gate.standstill:
            await clock.sleep(0.01)
        assert (clock.now() - lost_at) / SECOND < 0.9
        await clock.sleep(0.5)
        assert gate.latest.mode is GateMode.DISARMED
        rig.robot.ports["hand"].plug()
        receiver.inject("transmitter", "on")
        await clock.sleep(2.0)
        assert gate.latest.mode is GateMode.DISARMED, "the switch must be seen off"
        receiver.move(STICK, 0.0)
        receiver.move(ARM, -1.0)
        await clock.sleep(0.5)
        receiver.move(ARM, 1.0)
        await clock.sleep(0.5)
        assert gate.latest.mode in MOBILE

    on_truck(test, tmp_path, kind)


def test_nobody_drives_while_the_switch_is_off_and_the_stick_must_be_in_the_middle(tmp_path: Path):
    async def test(rig, clock, receiver, gate):
        operator = LocalOperator(rig.daemon, clock)
        await operator.order(Order.ARM)
        await clock.sleep(0.5)
        assert gate.latest.mode is GateMode.DISARMED
        receiver.move(STICK, 1.0)
        receiver.move(ARM, 1.0)
        await clock.sleep(0.5)
        assert gate.latest.mode is GateMode.DISARMED
        receiver.move(STICK, 0.0)
        receiver.move(ARM, -1.0)
        await clock.sleep(0.3)
        receiver.move(ARM, 1.0)
        await clock.sleep(0.3)
        assert gate.latest.mode in MOBILE
        receiver.move(ESTOP, 1.0)
        await clock.sleep(0.3)
        assert gate.latest.mode is GateMode.ESTOPPED
        with pytest.raises(RequestRefusedError):
            await operator.order(Order.ARM)

    on_truck(test, tmp_path, "crsf")
