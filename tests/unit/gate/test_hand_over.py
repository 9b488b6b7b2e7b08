"""An operator asks for the drive, the one who drives hands it over."""

import pytest

from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order, Role
from monstertruck_schemas.state import GateMode
from monstertruckd.gate.arbitration import ASKING
from tests.unit.gate.rig import Rig

ANN = {"source": "ann", "role": Role.STATION}
BOB = {"source": "bob", "role": Role.STATION}


def asked() -> Rig:
    """Ann drives, Bob has asked."""
    rig = Rig().driving(**ANN)
    assert rig.order(Order.ASK, **BOB) is Reason.OK
    rig.tick()
    assert (rig.out.asking, rig.out.holder) == (("bob",), "ann"), "asking changes nothing"
    return rig


def test_the_drive_goes_over_at_once_to_one_who_holds_the_stick_and_the_former_has_to_let_go_first():
    rig = asked()
    rig.drive(**BOB, speed=0.0)
    assert rig.order(Order.HAND_OVER, **ANN, to="bob") is Reason.OK
    rig.drive(**BOB, speed=0.1)
    rig.tick()
    assert (rig.out.holder, rig.out.mode, rig.out.asking, rig.out.handed_to) == ("bob", GateMode.DRIVING, (), "bob")
    assert rig.reported(Reason.DRIVE_HANDED)[0].text == "ann hands over to bob"
    for _ in range(60):  # ann still pushes, by rig.driver
        rig.drive(**BOB, speed=0.1)
        rig.tick()
        assert rig.out.holder == "bob"
    assert not rig.trips


def test_a_truck_handed_to_one_without_a_hand_on_the_stick_stops_by_its_ramp_and_waits_for_nobody_else():
    rig = asked()
    assert rig.order(Order.HAND_OVER, **ANN, to="bob") is Reason.OK
    rig.tick()
    assert rig.out.mode is GateMode.STOPPING
    assert rig.trips[-1].ordered
    assert rig.trips[-1].causes[0].text == "ann hands over to bob"
    rig.driver = {"source": "eve", "role": Role.STATION}
    rig.tick(20)
    assert rig.out.mode is GateMode.ARMED, "eve has to wait"
    rig.driver = None
    rig.drive(**BOB, speed=0.1)
    rig.tick()
    assert rig.out.holder == "bob"


def test_a_higher_priority_overrules_a_hand_over_and_a_lower_one_may_be_handed_to():
    rig = Rig().driving(source="pad", role=Role.GAMEPAD)
    rig.order(Order.ASK, **BOB)
    rig.drive(**BOB, speed=0.1)
    rig.order(Order.HAND_OVER, source="pad", role=Role.GAMEPAD, to="bob")
    rig.driver = {**BOB, "speed": 0.1}
    rig.tick()
    assert rig.out.holder == "bob"
    assert rig.order(Order.ESTOP, source="ann") is Reason.OK
    rig.tick()
    assert rig.out.mode is GateMode.ESTOPPED


def test_a_former_driver_who_never_lets_go_does_not_take_it_back_even_where_a_request_came_before_the_next_tick():
    pad = {"source": "pad", "role": Role.GAMEPAD}
    rig = Rig().driving(**pad)
    rig.order(Order.ASK, **BOB)
    rig.drive(**BOB, speed=0.1)
    rig.tick()
    rig.drive(**pad, speed=0.1)
    assert rig.order(Order.HAND_OVER, **pad, to="bob") is Reason.OK
    rig.driver = {**pad, "speed": 0.1}
    for _ in range(50 * 4):  # longer than others wait for bob
        rig.drive(**BOB, speed=0.1)
        rig.tick()
        assert rig.out.holder == "bob"
    rig.drive(**pad, speed=0.0)
    rig.tick()
    assert rig.out.holder == "pad", "who has let go has its priority again"


@pytest.mark.parametrize(
    ("order", "who", "to", "refused"),
    [
        (Order.ASK, ANN, None, Reason.BUSY),
        (Order.HAND_OVER, BOB, "bob", Reason.BAD_ROLE),
        (Order.HAND_OVER, ANN, "eve", Reason.BAD_INPUT),
        (Order.HAND_OVER, ANN, None, Reason.BAD_INPUT),
    ],
)
def test_what_makes_no_sense_is_refused(order: Order, who: dict, to: str | None, refused: Reason):
    rig = asked()
    assert rig.order(order, **who, to=to) is refused
    rig.tick()
    assert rig.out.holder == "ann"


def test_nobody_is_asked_where_no_operator_drives():
    rig = Rig().armed()
    assert rig.order(Order.ASK, **BOB) is Reason.NOT_FOUND
    rig = Rig().driving(source="track", role=Role.TRACKER, inside=True)
    assert rig.order(Order.ASK, **BOB) is Reason.NOT_FOUND


def test_who_asks_is_forgotten_and_many_names_take_no_room():
    rig = asked()
    for name in ("a", "b", "c", "d", "e"):
        rig.order(Order.ASK, source=name, role=Role.STATION)
    rig.tick()
    assert rig.out.asking == ("b", "c", "d", "e")
    rig.tick(50 * 20 + 1)
    assert rig.out.asking == ()


@pytest.mark.parametrize(("role", "drives"), [(Role.GAMEPAD, True), (Role.KEYBOARD, True), (Role.STATION, False)])
def test_who_outranks_the_former_driver_need_not_wait_for_the_one_it_was_handed_to(role: Role, drives: bool):
    rig = asked()
    assert rig.order(Order.HAND_OVER, **ANN, to="bob") is Reason.OK
    rig.tick()
    rig.driver = {"source": "eve", "role": role}
    rig.tick(20)
    assert (rig.out.holder == "eve") is drives


def test_who_asks_is_shown_to_the_last_instant_of_twenty_seconds():
    rig = asked()
    rig.order(Order.ASK, source="eve", role=Role.STATION)
    sources, until = rig.gate._sources, rig.now + ASKING
    assert sources.asking(until) == ("bob", "eve") or sources.asking(until) == ("eve",)
    assert sources.asking(until + 1) == ()
    sources.ask("kim", until)
    assert "eve" in sources.asking(until)
    sources.ask("leo", until + 1)
    assert "eve" not in sources.asking(until - 1), "forgotten, not only hidden"
