"""Keys become requests that stand for a moment only."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.req import Order
from monstertruckd.tools.driving.modes import SPEEDS, SteeringMode
from monstertruckd.tools.driving.teleop import MODE_KEYS, STEERING_KEY_STEPS, KeyReader, Teleop, TeleopRequest, axles

START = 5 * SECOND


def after(seconds: float) -> int:
    return START + round(seconds * SECOND)


@pytest.mark.parametrize(
    ("data", "keys"),
    [
        (b"wW\r \x04", ["w", "w", "enter", "space", "end"]),
        (b"\x1b[A\x1b[B\x1b[C\x1b[D\x1bOA", ["up", "down", "right", "left", "up"]),
        (b"\x1b[1;2A", ["up"]),
        (b"\x1b[I\x1b[O", ["focus in", "focus out"]),
        (b"\x1b[5~\x1b[Za\x01\xffd", ["a", "d"]),
        (b"\x1bw", []),
        (b"\x1b[200~wwwe\r\x1b[A\x1b[201~s", ["s"]),
    ],
)
def test_bytes_are_cut_into_keys_however_they_come(data: bytes, keys: list[str]):
    assert KeyReader().feed(data) == keys
    reader = KeyReader()
    assert [key for byte in data for key in reader.feed(bytes([byte]))] == keys


def test_escape_alone_is_a_key_once_nothing_follows():
    reader = KeyReader()
    assert reader.feed(b"\x1b") == []
    assert reader.flush() == ["escape"]
    assert reader.flush() == []
    assert reader.feed(b"\x1b[200~w\x1b") == []
    assert reader.flush() == [], "what is pasted is no key"
    reader.clear()
    assert reader.feed(b"w") == ["w"]


@given(st.lists(st.binary(max_size=12), max_size=12))
def test_any_bytes_are_survived(chunks: list[bytes]):
    reader = KeyReader()
    for chunk in chunks:
        assert all(isinstance(key, str) for key in reader.feed(chunk))


def test_a_key_stands_for_a_moment_and_then_there_is_one_stop_and_silence():
    teleop = Teleop(level=1, first_hold=0.6, hold=0.25)
    assert teleop.request(START) is None, "nothing is asked for before a key"
    assert teleop.press("w", START) is None
    assert teleop.request(after(0.6)) == TeleopRequest(0.1, 0.0, 0.0)
    assert teleop.request(after(0.61)) == TeleopRequest(0.0, 0.0, 0.0)
    assert teleop.request(after(0.66)) is None
    assert teleop.request(after(9.0)) is None


def test_repetition_keeps_it_alive_and_its_end_is_noticed_sooner():
    teleop = Teleop(first_hold=0.6, hold=0.25)
    for tenth in range(0, 30, 1):
        teleop.press("w", after(tenth / 10))
        assert teleop.request(after(tenth / 10 + 0.09)) == TeleopRequest(0.1, 0.0, 0.0)
    assert teleop.request(after(2.9 + 0.25)) is not None
    assert teleop.request(after(2.9 + 0.26)) == TeleopRequest(0.0, 0.0, 0.0)


def test_a_steering_key_keeps_the_truck_going_but_never_sets_it_in_motion():
    teleop = Teleop(angle=0.4)
    teleop.press("a", START)
    assert teleop.request(START) == TeleopRequest(0.0, 0.4 / STEERING_KEY_STEPS, 0.0)
    teleop.press("up", after(0.1))
    teleop.press("left", after(0.2))
    assert teleop.request(after(0.75)) == TeleopRequest(0.1, 2 * 0.4 / STEERING_KEY_STEPS, 0.0)
    teleop.request(after(2.0))
    teleop.press("left", after(3.0))
    request = teleop.request(after(3.0))
    assert request is not None
    assert request.speed == 0.0, "what stood before the silence is forgotten"


def test_steering_ends_at_full_lock_and_centres():
    teleop = Teleop(angle=0.4)
    for _ in range(3 * STEERING_KEY_STEPS):
        teleop.press("d", START)
    assert teleop.request(START) == TeleopRequest(0.0, -0.4, 0.0)
    teleop.press("x", START)
    assert teleop.request(START) == TeleopRequest(0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("mode", "front", "rear"),
    [
        (SteeringMode.FRONT, 0.2, 0.0),
        (SteeringMode.REAR, 0.0, -0.2),
        (SteeringMode.COUNTER, 0.2, -0.2),
        (SteeringMode.CRAB, 0.2, 0.2),
        (SteeringMode.HYBRID, 0.2, -0.1),
    ],
)
def test_modes_turn_left_by_their_own_axles(mode: SteeringMode, front: float, rear: float):
    assert axles(mode, 0.2, 0.1) == (front, rear)


def test_keys_of_the_twist_mode_turn_and_move_sideways():
    teleop = Teleop(mode=SteeringMode.TWIST)
    teleop.press("a", START)
    assert teleop.request(START) == TeleopRequest(0.0, 0.0, 0.0, (0.0, 0.0, pytest.approx(0.5))), "on the spot"
    teleop.press("w", after(0.1))
    assert teleop.request(after(0.1)).twist == pytest.approx((0.1, 0.0, 0.5))
    teleop.press("d", after(0.2))
    assert teleop.request(after(0.2)).twist == pytest.approx((0.1, 0.0, -0.5))
    assert teleop.request(after(1.0)).twist == (0.0, 0.0, 0.0), "one standstill of the same form"
    assert teleop.request(after(1.1)) is None
    teleop.press("z", after(2.0))
    assert teleop.request(after(2.0)).twist == pytest.approx((0.0, 0.1, 0.0)), "what was held before is forgotten"
    teleop.press("c", after(2.1))
    assert teleop.request(after(2.1)).twist == pytest.approx((0.0, -0.1, 0.0))
    teleop.press("x", after(2.2))
    assert teleop.request(after(2.2)).twist == (0.0, 0.0, 0.0)


def test_another_mode_forgets_the_twist():
    teleop = Teleop(mode=SteeringMode.TWIST)
    teleop.press("a", START)
    teleop.press("1", START)
    assert teleop.request(START) == TeleopRequest(0.0, 0.0, 0.0)


def test_no_mode_asks_for_more_than_full_lock():
    teleop = Teleop(angle=0.4, mode=SteeringMode.HYBRID)
    for key in "dz" * STEERING_KEY_STEPS:
        teleop.press(key, START)
    assert teleop.request(START) == TeleopRequest(0.0, -0.4, 0.4)


def test_the_second_control_reverses_or_drives_on_into_unseen_ground_while_it_is_held():
    teleop = Teleop(angle=0.4)
    teleop.press("v", START)
    assert teleop.request(START) == TeleopRequest(-0.1, 0.0, 0.0, unseen=True)
    teleop.press("s", after(0.1))
    assert teleop.request(after(0.1)) == TeleopRequest(-0.1, 0.0, 0.0), "another key ends it"
    teleop.press("v", after(0.2))
    assert teleop.request(after(0.9)) == TeleopRequest(0.0, 0.0, 0.0), "no key does either"
    teleop.press("6", after(1.0))
    teleop.press("z", after(1.0))
    teleop.press("v", after(1.1))
    assert teleop.request(after(1.1)) == TeleopRequest(0.0, 0.0, 0.0, (0.0, 0.1, 0.0), unseen=True)


def test_keys_choose_mode_and_speed():
    teleop = Teleop()
    for key, mode in MODE_KEYS.items():
        teleop.press(key, START)
        assert teleop.mode is mode
    for _ in range(9):
        teleop.press("+", START)
    assert teleop.speed == SPEEDS[-1]
    for _ in range(9):
        teleop.press("-", START)
    assert teleop.speed == SPEEDS[0]
    assert teleop.request(START) is None, "these keys drive nothing"


@pytest.mark.parametrize(
    ("key", "command"),
    [("space", Order.ESTOP), ("escape", Order.STOP), ("e", Order.ESTOP), ("r", Order.RESET), ("q", "end")],
)
def test_orders_and_the_end_silence_the_keys(key: str, command: object):
    teleop = Teleop()
    teleop.press("w", START)
    teleop.request(START)
    assert teleop.press(key, START) == command
    assert teleop.request(after(0.05)) == TeleopRequest(0.0, 0.0, 0.0)
    assert teleop.request(after(0.1)) is None


def test_losing_the_focus_silences_the_keys():
    teleop = Teleop()
    teleop.press("w", START)
    teleop.request(START)
    assert teleop.press("focus out", START) is None
    assert teleop.request(after(0.05)) == TeleopRequest(0.0, 0.0, 0.0)
    assert teleop.request(after(0.1)) is None


def test_arming_holds_the_truck_at_rest_for_a_moment():
    teleop = Teleop(arm_hold=2.0)
    teleop.press("w", START)
    assert teleop.press("enter", START) is Order.ARM
    assert teleop.request(after(1.9)) == TeleopRequest(0.0, 0.0, 0.0)
    teleop.press("w", after(1.95))
    assert teleop.request(after(2.0)) == TeleopRequest(0.1, 0.0, 0.0)
    assert teleop.request(after(2.6)) == TeleopRequest(0.0, 0.0, 0.0)
    assert teleop.request(after(2.7)) is None


def test_a_key_pressed_while_the_truck_is_held_at_rest_stands_no_longer_than_any_other():
    teleop = Teleop(arm_hold=2.0)
    teleop.press("enter", START)
    teleop.press("w", after(0.3))
    assert teleop.request(after(0.35)) == TeleopRequest(0.1, 0.0, 0.0)
    assert teleop.request(after(0.95)) == TeleopRequest(0.0, 0.0, 0.0)
    assert teleop.request(after(1.9)) == TeleopRequest(0.0, 0.0, 0.0)
    assert teleop.request(after(2.1)) == TeleopRequest(0.0, 0.0, 0.0)
    assert teleop.request(after(2.2)) is None
