"""A unit that turns by itself loses its torque; one that is pushed keeps it."""

import pytest

from monstertruck_drivers.ax12 import protocol as p
from monstertruck_drivers.ax12.protocol import Alarm, Register
from monstertruck_drivers.ax12.session import Ax12Session
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import TorqueState
from tests.unit.drivers.ax12.rig import Rig, on_bench


@pytest.mark.parametrize("requested", [False, True])
def test_a_unit_that_drives_itself_away_from_its_goal_loses_its_torque_within_0_2_s(requested: bool):
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(0.3)
            if requested:
                rig.request(0.1, 0.0)
                await rig.settle(0.5)
            rig.bus.inject("stray", "1", "420")
            await rig.settle(0.2)
            assert rig.events.reasons() == [Reason.UNCOMMANDED_MOTION]
            assert rig.out.kept[-1].pitch_joint.torque is TorqueState.LIMP
            assert (rig.out.kept[-1].pitch_joint.strays, rig.out.kept[-1].roll_joint.strays) == (1, 0)
            assert rig.out.kept[-1].roll_joint.torque is TorqueState.HOLDING
            stands = rig.joint("pitch")
            await rig.settle(1.0)
            assert rig.joint("pitch") == stands

    on_bench(test)


def test_an_order_that_only_a_late_answer_confirms_is_repeated(monkeypatch: pytest.MonkeyPatch):
    """The answer to an earlier write looks like the one to this."""
    write, lost = Ax12Session.write, [b"\x00"]

    async def write_or_lose(session: Ax12Session, unit: int, start: Register, data: bytes, retries: int = 2) -> Alarm:
        if start is p.TORQUE_ENABLE and data in lost:
            lost.remove(data)
            return Alarm(0)
        return await write(session, unit, start, data, retries)

    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(0.3)
            monkeypatch.setattr(Ax12Session, "write", write_or_lose)
            rig.bus.inject("stray", "1", "420")
            await rig.settle(0.25)
            assert lost == []
            assert rig.out.kept[-1].pitch_joint.torque is TorqueState.LIMP
            assert not rig.unit(1).get(p.TORQUE_ENABLE)
            assert rig.events.reasons() == [Reason.UNCOMMANDED_MOTION]

    on_bench(test)


def test_it_gets_its_torque_back_after_a_rest_that_doubles_when_it_strays_again():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(0.3)
            for rest, goal in ((3.0, "420"), (6.0, "600")):
                rig.bus.inject("stray", "1", goal)
                await rig.settle(rest - 0.1)
                assert rig.out.kept[-1].pitch_joint.torque is TorqueState.LIMP
                rig.bus.inject("stray", "1", "off")
                await rig.settle(0.4)
                assert rig.out.kept[-1].pitch_joint.torque is TorqueState.HOLDING
            assert rig.events.reasons() == 2 * [Reason.UNCOMMANDED_MOTION, Reason.DEVICE_READY]

    on_bench(test)


def test_a_load_that_pushes_a_joint_away_from_its_goal_is_no_motion_of_its_own():
    pushes = [0.0]

    def load(ident: int, _time_ns: int) -> float:
        return pushes[-1] if ident == 1 else 0.0

    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(0.5)
            for push in (0.4, 0.9, 1.4, 0.0, -1.2):
                pushes.append(push)
                await rig.settle(0.4)
            assert Reason.UNCOMMANDED_MOTION not in rig.events.reasons()

    on_bench(test, load=load)


def test_goals_to_and_fro_at_full_speed_are_no_motion_of_its_own():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(0.3)
            for turn in range(60):
                rig.request(0.4 * (-1) ** turn, 0.3 * (-1) ** (turn // 2))
                await rig.settle(0.013 + 0.007 * turn)
            assert rig.events.kept == []

    on_bench(test)
