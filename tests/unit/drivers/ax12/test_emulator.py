"""The emulated bus byte by byte: what real units answer, refuse, garble."""

import pytest

from monstertruck_drivers.ax12 import protocol as p
from monstertruck_drivers.ax12.emulator import Ax12Bus
from monstertruck_drivers.ax12.protocol import Alarm, Packet
from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.errors import InputError
from tests.unit.drivers.ax12.rig import Host, instruction, on_wire, reg_write, value, write


def test_documented_exchange():
    async def test(bus: Ax12Bus, host: Host, _clock) -> None:
        assert await host.raw(p.ping(1)) == bytes.fromhex("FF FF 01 02 00 FC")
        bus.inject("heat", "1", "32")
        assert await host.raw(p.read(1, p.PRESENT_TEMPERATURE, 1)) == bytes.fromhex("FF FF 01 03 00 20 DB")
        assert await host.raw(bytes.fromhex("FF FF 01 07 03 1E FF 01 66 00 70")) == bytes.fromhex("FF FF 01 02 00 FC")
        assert await host.raw(p.ping(7)) == b""
        assert bytes(bus.received).startswith(p.ping(1))

    on_wire(test)


def test_an_answer_takes_line_return_delay_and_adapter():
    async def test(bus: Ax12Bus, host: Host, clock) -> None:
        assert await host.raw(p.read(1, p.PRESENT_POSITION, 8), 0.00170) == b""
        await clock.sleep(0.1)
        assert len(await host.raw(p.read(1, p.PRESENT_POSITION, 8), 0.00176)) == 14
        await host.status(write(1, p.RETURN_DELAY, 0))
        assert len(await host.raw(p.read(1, p.PRESENT_POSITION, 8), 0.00126)) == 14
        bus.latency_s = 0.016
        assert await host.raw(p.ping(1), 0.016) == b""

    on_wire(test)


def test_answers_keep_the_order_of_the_requests():
    async def test(_bus, host: Host, _clock) -> None:
        await host.status(write(2, p.RETURN_DELAY, 0))
        assert [packet.unit for packet in await host.ask(p.ping(1) + p.ping(2))] == [1, 2]

    on_wire(test)


def test_up_to_six_units():
    async def test(_bus, host: Host, _clock) -> None:
        for ident in range(1, 7):
            assert (await host.status(p.ping(ident))).unit == ident

    on_wire(test, ids=range(1, 7))


@pytest.mark.parametrize("ids", [range(7), (254,), (-1,)])
def test_impossible_buses_are_refused(ids):
    async def main(clock: VirtualClock) -> None:
        with pytest.raises(InputError, match=r"at most 6, each 0\.\.253"):
            Ax12Bus(clock, ids=tuple(ids))

    run_virtual(main)


def test_an_echo_comes_before_the_answer():
    async def test(bus: Ax12Bus, host: Host, _clock) -> None:
        request = p.ping(1)
        assert await host.raw(request) == request + Packet(1, 0).encode()
        assert await host.raw(instruction(p.BROADCAST, p.Instruction.ACTION)) == instruction(
            p.BROADCAST, p.Instruction.ACTION
        )
        bus.inject("echo", "off")
        assert await host.raw(request) == Packet(1, 0).encode()

    on_wire(test, echo=True)


@pytest.mark.parametrize("level", [0, 1, 2])
def test_status_level_decides_what_is_answered(level: int):
    async def test(_bus, host: Host, _clock) -> None:
        await host.ask(write(1, p.STATUS_LEVEL, level))
        assert len(await host.ask(p.ping(1))) == 1
        assert len(await host.ask(p.read(1, p.ID, 1))) == (level >= 1)
        assert len(await host.ask(write(1, p.LED, 1))) == (level >= 2)
        assert len(await host.ask(instruction(1, p.Instruction.RESET))) == (level >= 2)

    on_wire(test, ids=(1,))


def test_a_broadcast_is_obeyed_in_silence():
    async def test(bus: Ax12Bus, host: Host, _clock) -> None:
        assert await host.ask(write(p.BROADCAST, p.LED, 1)) == []
        assert [unit.get(p.LED) for unit in bus.units] == [1, 1]
        assert await host.ask(p.ping(p.BROADCAST)) == []
        bus.inject("vanish", "2")
        assert [packet.unit for packet in await host.ask(p.ping(p.BROADCAST))] == [1]

    on_wire(test)


@pytest.mark.parametrize("answers", [True, False])
def test_a_wrong_sum_is_answered_by_its_error_bit_or_not_at_all(answers: bool):
    async def test(bus: Ax12Bus, host: Host, _clock) -> None:
        damaged = bytearray(write(1, p.LED, 1))
        damaged[-1] ^= 1
        assert await host.ask(bytes(damaged)) == ([Packet(1, Alarm.CHECKSUM)] if answers else [])
        assert bus.units[0].get(p.LED) == 0
        assert (await host.status(p.ping(1))).code == 0

    on_wire(test, answers_damage=answers)


def test_half_a_packet_is_given_up_after_a_pause():
    async def test(_bus, host: Host, _clock) -> None:
        assert await host.raw(p.ping(1)[:4], wait=0.2) == b""
        assert (await host.status(p.ping(1))).unit == 1
        assert await host.raw(p.ping(1)[:4], wait=0.01) == b""
        assert (await host.status(p.ping(1)[4:])).unit == 1, "a short pause does not matter"

    on_wire(test)


@pytest.mark.parametrize(
    ("request_", "bits"),
    [
        (write(1, p.LED, 2), Alarm.RANGE),
        (p.write(1, p.GOAL_POSITION, b"\x00\x04"), Alarm.RANGE),
        (write(1, p.MODEL_NUMBER, 12), Alarm.RANGE),
        (p.write(1, p.PUNCH, b"\x00\x00\x00"), Alarm.RANGE),
        (p.read(1, p.PUNCH, 3), Alarm.RANGE),
        (write(1, p.GOAL_POSITION, 300), Alarm.ANGLE),
        (reg_write(1, p.GOAL_POSITION, p.GOAL_POSITION.encode(300)), Alarm.ANGLE),
        (Packet(1, p.Instruction.BULK_READ, b"\x00\x02\x01\x24").encode(), Alarm.INSTRUCTION),
        (Packet(1, 0x55).encode(), Alarm.INSTRUCTION),
        (instruction(1, p.Instruction.ACTION), Alarm.INSTRUCTION),
    ],
)
def test_what_cannot_be_done_is_refused_by_its_bit(request_: bytes, bits: Alarm):
    async def test(bus: Ax12Bus, host: Host, _clock) -> None:
        await host.status(p.write(1, p.CW_LIMIT, p.CW_LIMIT.encode(409) + p.CCW_LIMIT.encode(613)))
        before = [bus.units[0].get(register) for register in p.REGISTERS]
        assert await host.status(request_) == Packet(1, bits)
        assert [bus.units[0].get(register) for register in p.REGISTERS] == before
        assert (await host.status(p.ping(1))).code == 0, "it was the request's error, not the unit's"

    on_wire(test)


def test_registered_writes_wait_for_the_action():
    async def test(bus: Ax12Bus, host: Host, _clock) -> None:
        for unit in (1, 2):
            await host.status(reg_write(unit, p.GOAL_POSITION, p.GOAL_POSITION.encode(600)))
            assert await value(host, unit, p.REGISTERED) == 1
            assert await value(host, unit, p.GOAL_POSITION) == 0
        assert await host.ask(instruction(p.BROADCAST, p.Instruction.ACTION)) == []
        assert [unit.get(p.GOAL_POSITION) for unit in bus.units] == [600, 600]
        assert await value(host, 1, p.REGISTERED) == 0

    on_wire(test)


def test_sync_write_reaches_the_named_units_and_nobody_answers():
    async def test(bus: Ax12Bus, host: Host, _clock) -> None:
        goals = {1: p.GOAL_POSITION.encode(500), 3: p.GOAL_POSITION.encode(250), 9: p.GOAL_POSITION.encode(1)}
        assert await host.ask(p.sync_write(p.GOAL_POSITION, goals)) == []
        assert [unit.get(p.GOAL_POSITION) for unit in bus.units] == [500, 0, 250]
        ragged = Packet(p.BROADCAST, p.Instruction.SYNC_WRITE, bytes((p.GOAL_POSITION.address, 2, 1, 0))).encode()
        assert await host.ask(ragged) == []
        assert bus.units[0].get(p.GOAL_POSITION) == 500

    on_wire(test, ids=(1, 2, 3))


def test_stored_settings_survive_the_supply_and_the_others_do_not():
    async def test(bus: Ax12Bus, host: Host, _clock) -> None:
        await host.status(write(1, p.MAX_TORQUE, 700))
        await host.status(write(1, p.MOVING_SPEED, 100))
        await host.status(write(1, p.LOCK, 1))
        assert (await host.status(write(1, p.ID, 3))).code == Alarm.RANGE, "locked"
        assert (await host.status(write(1, p.LOCK, 0))).code == Alarm.RANGE, "only the supply unlocks"
        bus.power_cycle()
        assert await value(host, 1, p.MAX_TORQUE) == 700
        assert await value(host, 1, p.TORQUE_LIMIT) == 700, "copied at power-up"
        assert await value(host, 1, p.MOVING_SPEED) == 0
        assert (await host.status(write(1, p.ID, 3))).code == 0
        assert (await host.status(p.ping(3))).unit == 3

    on_wire(test)


def test_the_12_v_rail_silences_all_units_and_nothing_else():
    async def test(bus: Ax12Bus, host: Host, _clock) -> None:
        bus.inject("power", "off")
        assert await host.ask(p.ping(1)) == await host.ask(p.ping(2)) == []
        bus.inject("power", "on")
        assert len(await host.ask(p.ping(1)) + await host.ask(p.ping(2))) == 2

    on_wire(test)


def test_factory_reset_makes_it_number_1_and_two_of_a_number_garble():
    async def test(bus: Ax12Bus, host: Host, _clock) -> None:
        assert (await host.status(instruction(2, p.Instruction.RESET))).unit == 2
        assert await host.ask(p.ping(2)) == []
        heard = await host.raw(p.ping(1))
        assert len(heard) == 6
        assert heard != Packet(1, 0).encode()
        await host.ask(write(1, p.LED, 1))
        assert [unit.get(p.LED) for unit in bus.units] == [1, 1], "both obey"

    on_wire(test)


def test_a_unit_at_another_baud_rate_is_deaf():
    async def test(_bus, host: Host, _clock) -> None:
        await host.status(write(1, p.BAUD_CODE, 16))
        assert await host.ask(p.ping(1)) == []
        assert len(await host.ask(p.ping(2))) == 1

    on_wire(test)


def test_damaged_answers():
    async def test(bus: Ax12Bus, host: Host, _clock) -> None:
        good = Packet(1, 0).encode()
        bus.inject("truncate")
        assert await host.raw(p.ping(1)) == good[:-2]
        bus.inject("double", "2")
        assert await host.raw(p.ping(1)) == good * 2
        assert await host.raw(p.ping(1)) == good * 2
        bus.inject("garble")
        assert await host.ask(p.ping(1)) == []
        bus.inject("mute", "1")
        assert await host.raw(p.ping(1)) == b""
        bus.inject("late", "0.05")
        assert await host.raw(p.ping(1), 0.045) == b""
        assert await host.raw(b"", 0.01) == good
        assert await host.raw(p.ping(1)) == good, "all of it is over"

    on_wire(test)


def test_a_unit_vanishes_and_returns():
    async def test(bus: Ax12Bus, host: Host, _clock) -> None:
        bus.inject("vanish", "2")
        assert await host.ask(p.ping(2)) == []
        assert len(await host.ask(p.ping(1))) == 1
        bus.inject("return", "2")
        assert len(await host.ask(p.ping(2))) == 1

    on_wire(test)
