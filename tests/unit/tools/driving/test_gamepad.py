"""Driving by gamepad: bytes of the kernel's records to motions and orders, and a device that comes and goes."""

import asyncio
import errno
import io
import os
from pathlib import Path

import pytest

from monstertruck_runtime.clock import SECOND, WallClock
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.req import Role
from monstertruckd.tools.driving import gamepad_device
from monstertruckd.tools.driving.gamepad import AXES, BUTTONS, EVENT, Pad, PadMapping, key_for, read_mapping
from monstertruckd.tools.driving.gamepad_device import EFFECT, PadLink
from monstertruckd.tools.driving.modes import SteeringMode
from monstertruckd.tools.driving.session import NEUTRAL_REQUESTS, DriveSession
from monstertruckd.tools.driving.teleop import Teleop

RANGES = {0: (-32768, 32767), 1: (-32768, 32767), 3: (-32768, 32767), 5: (0, 255), 16: (-1, 1), 17: (-1, 1)}
SYN = EVENT.pack(1700000000, 1, 0, 0, 0)


def key(name: str, value: int = 1) -> bytes:
    return EVENT.pack(1700000000, 0, 4, 4, 0x90001) + EVENT.pack(1700000000, 0, 1, BUTTONS[name], value) + SYN


def axis(name: str, value: int) -> bytes:
    return EVENT.pack(1700000000, 0, 3, AXES[name], value) + SYN


def pad(**mapping) -> Pad:
    return Pad("Test Pad", PadMapping(**mapping), RANGES)


def test_bytes_of_a_hand_at_64_bit_records():
    assert (EVENT.size, EFFECT.size) == (24, 48)
    recorded = bytes.fromhex(  # right shoulder pressed, left stick fully ahead
        "00f15365000000000000000000000000010037010100000000f153650000000000000000000000000300010000 80ffff"
        "00f1536500000000000000000000000000000000 00000000".replace(" ", "")
    )
    hand = pad()
    for i in range(0, len(recorded), 7):  # in any pieces
        hand.feed(recorded[i : i + 7])
    assert hand.held
    assert hand.motion(SteeringMode.FRONT, 0.2, 0.4).speed == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("mode", "wanted"),
    [
        (SteeringMode.FRONT, (0.1, 0.4, 0.0, None)),
        (SteeringMode.COUNTER, (0.1, 0.4, -0.4, None)),
        (SteeringMode.CRAB, (0.1, 0.4, 0.4, None)),
        (SteeringMode.TWIST, (0.0, 0.0, 0.0, (0.1, 0.0, 1.0))),
    ],
)
def test_sticks_ask_for_the_motion_of_the_steering_mode_while_the_deadman_button_is_held(mode, wanted):
    hand = pad()
    hand.feed(axis("left_x", -32768) + axis("left_y", -16384))
    assert not hand.held
    assert not any(getattr(hand.motion(mode, 0.2, 0.4), name) for name in ("speed", "front", "rear"))
    hand.feed(key("right_shoulder"))
    motion = hand.motion(mode, 0.2, 0.4)
    assert (motion.speed, motion.front, motion.rear) == pytest.approx(wanted[:3], abs=1e-3)
    assert motion.twist == (wanted[3] if wanted[3] is None else pytest.approx(wanted[3], abs=1e-3))
    hand.feed(key("right_shoulder", 0))
    assert not hand.held


@pytest.mark.parametrize(
    ("mapping", "confirms"),
    [({}, True), ({"unseen": ()}, False), ({"deadman": ("right_shoulder", "left_shoulder")}, False)],
)
def test_a_second_button_confirms_a_drive_into_unseen_ground(mapping, confirms):
    hand = pad(**mapping)
    hand.feed(axis("left_y", -32768) + key("right_shoulder"))
    for mode in (SteeringMode.FRONT, SteeringMode.TWIST):
        assert not hand.motion(mode, 0.2, 0.4).unseen
    hand.feed(key("left_shoulder"))
    for mode in (SteeringMode.FRONT, SteeringMode.TWIST):
        assert hand.motion(mode, 0.2, 0.4).unseen is confirms
    hand.feed(key("left_shoulder", 0))
    assert not hand.motion(SteeringMode.FRONT, 0.2, 0.4).unseen


def test_the_middle_is_the_middle_and_a_trigger_is_a_deadman_too():
    hand = pad(deadman=("right_trigger",))
    hand.feed(axis("left_y", 900) + axis("right_trigger", 100))
    assert not hand.held
    hand.feed(axis("right_trigger", 220))
    assert hand.held
    assert hand.motion(SteeringMode.FRONT, 0.2, 0.4).speed == 0.0


def test_after_lost_records_and_pauses_the_deadman_button_must_be_pressed_anew():
    for lose in (lambda hand: hand.feed(EVENT.pack(0, 0, 0, 3, 0)), Pad.release):
        hand = pad()
        hand.feed(key("right_shoulder") + axis("left_y", -32768))
        lose(hand)
        hand.feed(axis("left_y", -32768))
        assert not hand.held
        hand.feed(key("right_shoulder", 0))
        hand.feed(key("right_shoulder"))
        assert hand.held


def test_an_emergency_stop_counts_whose_last_release_was_among_the_lost_records():
    hand = pad()
    assert hand.feed(key("east")) == ["estop"]
    hand.feed(EVENT.pack(0, 0, 0, 3, 0))
    assert hand.feed(key("start", 2)) == []
    assert hand.feed(key("east")) == ["estop"]


def test_buttons_and_the_cross_give_each_order_once():
    hand = pad()
    assert hand.feed(key("start") + key("start", 2) + key("start", 0) + key("east")) == ["arm", "estop"]
    assert hand.feed(axis("hat_x", 1) + axis("hat_x", 1) + axis("hat_x", 0) + axis("hat_y", -1)) == [
        "next_mode",
        "faster",
    ]
    assert hand.feed(key("mode")) == []
    assert (key_for("estop", SteeringMode.FRONT), key_for("arm", SteeringMode.FRONT)) == ("space", "enter")
    assert (key_for("next_mode", SteeringMode.TWIST), key_for("previous_mode", SteeringMode.FRONT)) == ("1", "6")


def test_a_mapping_is_read_and_a_wrong_one_refused_by_field(tmp_path: Path):
    file = tmp_path / "pad.yaml"
    file.write_text("name: Test*\nspeed: right_y\ninverted: [speed]\ndeadman: [south]\nbuttons: {start: estop}\n")
    hand = Pad("Test Pad", read_mapping(file), {4: (0, 255)})
    assert hand.mapping.fits("Test Pad")
    assert not hand.mapping.fits("Mouse")
    hand.feed(key("south") + axis("right_y", 255))
    assert hand.motion(SteeringMode.FRONT, 0.2, 0.4).speed == pytest.approx(0.2)
    assert hand.feed(key("start")) == ["estop"]
    for text, said in (("deadman: []", "deadman"), ("buttons: {start: fly}", "buttons"), ("spead: left_y", "spead")):
        file.write_text(text)
        with pytest.raises(InputError, match=said):
            read_mapping(file)


def test_a_held_gamepad_goes_before_the_keys_and_what_follows_is_standstill():
    session = DriveSession(Teleop(), WallClock(), None, io.StringIO(), PadMapping())
    assert session._gamepad is not None
    assert session._input(SECOND) == (None, Role.KEYBOARD)
    hand = session._gamepad.pad = pad()
    hand.feed(key("right_shoulder") + axis("left_y", -32768))
    session._teleop.press("s", SECOND)
    request, role = session._input(SECOND)
    assert role is Role.GAMEPAD
    assert request.speed > 0
    session._gamepad.pad = None  # unplugged in full travel
    for _ in range(NEUTRAL_REQUESTS):
        request, role = session._input(10 * SECOND)
        assert (request.speed, role) == (0.0, Role.GAMEPAD)
    assert session._input(10 * SECOND)[1] is Role.KEYBOARD


async def test_a_gamepad_is_found_read_and_found_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(gamepad_device, "GAMEPAD_LOOK_PERIOD", 0.02)
    monkeypatch.setattr(gamepad_device, "described", lambda file, mapping: Pad("Test Pad", mapping, RANGES))
    actions = []
    link = PadLink(PadMapping(), WallClock(), actions.append, tmp_path)
    running = asyncio.create_task(link.run())
    try:
        await asyncio.sleep(0.03)
        assert link.hint == f"no gamepad in {tmp_path}"
        os.mkfifo(tmp_path / "event7")
        while link.pad is None:
            await asyncio.sleep(0.01)
        far = os.open(tmp_path / "event7", os.O_RDWR)
        os.write(far, key("right_shoulder") + key("start"))
        while not actions:
            await asyncio.sleep(0.01)
        assert link.pad.held
        link.rumble(1.0, 0.5)  # a pipe cannot, and nothing comes of it
        assert actions == ["arm"]
        # A pause of the program: far more waits than one read takes, orders to arm and to stop last.
        orders = key("start", 0) + key("start") + key("east") + key("right_shoulder", 2)
        os.write(far, axis("left_y", -900) * 200 + orders)
        link.flush()
        await asyncio.sleep(0.03)
        assert actions == ["arm", "estop"], "an emergency stop counts, however late"
        assert not link.pad.held

        def gone(*_):
            raise OSError(errno.ENODEV, "No such device")

        with monkeypatch.context() as patch:
            patch.setattr(gamepad_device.os, "read", gone)
            os.write(far, SYN)
            while link.pad is not None:
                await asyncio.sleep(0.005)
        while link.pad is None:
            await asyncio.sleep(0.01)
        assert not link.pad.held, "another one, in nobody's hand"
        os.close(far)
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
