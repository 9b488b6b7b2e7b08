"""Checks as such: the list can only get stricter, whatever one of them says; the fence; checks that fail."""

import math

import numpy as np
import pytest

from monstertruck_planners.zones.shapes import inside
from monstertruck_runtime.plugins import Catalog
from monstertruck_schemas import topics
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.event import Measurement
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order
from monstertruck_schemas.state import GateMode, Odometry
from monstertruckd.gate.catalog import CheckConfig, FenceConfig
from monstertruckd.gate.checks import Check, Checks, PaceLimit
from tests.unit.gate.rig import Rig, header, make_gate, show


class Saying(Check):
    """Says what a test wants."""

    reasons = (Reason.OWN_CHECK,)
    says: tuple = ()
    blocks: tuple = ()

    def __init__(self, config, view):
        super().__init__(view)

    def limit(self, now, courses):
        return self.says

    def reason(self, now):
        return self.blocks

    def figures(self, reason, now):
        yield Measurement(name="depth", value=0.5, unit="m")


def own_rig(monkeypatch, check, **config):
    """A rig whose gate has a check of a third party."""
    monkeypatch.setattr(Catalog, "build", lambda _self, _config, *arguments: check(*arguments))
    rig = Rig(**config)
    rig.gate = make_gate(own={"mine": CheckConfig(kind="mine")}, **config)
    return rig


@pytest.mark.parametrize(
    ("pace", "speed"), [(math.inf, 0.2), (5.0, 0.2), (0.05, 0.05), (-1.0, 0.0), (0.0, 0.0), (math.nan, 0.0)]
)
def test_a_check_can_only_slow_the_truck(pace, speed, monkeypatch):
    rig = own_rig(monkeypatch, type("Mine", (Saying,), {"says": (PaceLimit(Reason.OWN_CHECK, pace),)})).armed()
    rig.driver = {"speed": 0.2}
    rig.tick(60)
    assert rig.out.speeds[0] == pytest.approx(speed)


def test_the_least_limit_of_all_checks_with_one_reason_counts():
    mine = [type("Mine", (Saying,), {"says": (PaceLimit(Reason.TILT_SLOW, pace),)}) for pace in (0.1, 0.2)]
    low, high = (check(None, None) for check in mine)
    for order in ((low, high), (high, low)):
        assert Checks(order).limits(0, None) == {Reason.TILT_SLOW: 0.1}


def test_a_check_that_blocks_stops_the_truck_with_its_name_and_figures(monkeypatch):
    mine = type("Mine", (Saying,), {})
    rig = own_rig(monkeypatch, mine).driving(speed=0.2)
    mine.blocks = (Reason.OWN_CHECK,)
    rig.tick()
    assert rig.out.mode is GateMode.STOPPING
    cause = rig.trips[-1].causes[0]
    assert cause.text == f"mine: {Reason.OWN_CHECK.text}"
    assert cause.measurements[0].value == 0.5
    assert rig.reported(Reason.OWN_CHECK)[0].text == cause.text


@pytest.mark.parametrize("method", ["observe", "reason", "limit", "urgent"])
def test_a_check_that_raises_stops_the_truck_for_good(method, monkeypatch):
    def fail(*_):
        raise ValueError("bad depth")

    mine = type("Mine", (Saying,), {})
    rig = own_rig(monkeypatch, mine).driving(speed=0.2)
    setattr(mine, method, property(fail) if method == "urgent" else fail)
    rig.tick(3)
    assert rig.out.mode is not GateMode.DRIVING
    assert "mine failed: ValueError: bad depth" in rig.trips[-1].text
    setattr(mine, method, getattr(Saying, method))
    rig.driver = None
    rig.tick(200)
    assert rig.decide(Order.ARM).text.startswith("mine failed"), "until the daemon is restarted"


@pytest.mark.parametrize("says", [("fast",), (PaceLimit("fast", 1.0),), (PaceLimit(Reason.OWN_CHECK, "fast"),)])
def test_a_truck_whose_check_says_nonsense_is_not_armed(says, monkeypatch):
    rig = own_rig(monkeypatch, type("Mine", (Saying,), {"says": says}))
    rig.tick(2)
    assert rig.decide(Order.ARM).text.startswith("mine failed")


# Fence

SQUARE = ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))


def test_points_are_inside_or_not():
    points = np.array([[[0.0, 0.0], [1.5, 0.0]], [[0.9, -0.9], [0.0, -1.1]]])
    assert inside(points, np.array(SQUARE)).tolist() == [[True, False], [True, False]]


def fenced(x, y=0.0, yaw=0.0):
    rig = Rig()
    rig.gate = make_gate(own={"room": FenceConfig(kind="fence", corners=SQUARE)})
    sense = rig.sense

    def sensed():
        sense()
        if rig.place is not None:
            px, py, pyaw = rig.place
            show(
                rig.gate,
                Odometry(
                    **header(rig.now),
                    frame="map",
                    child="base",
                    pose=Pose2D(x=px, y=py, yaw=pyaw),
                    twist=Twist2D(vx=0.0, vy=0.0, wz=0.0),
                    pose_covariance=(0.0,) * 9,
                    twist_covariance=(0.0,) * 9,
                    age=0.0,
                ),
            )

    rig.sense, rig.place = sensed, (x, y, yaw)
    return rig


def test_the_truck_stops_before_the_fence_and_may_drive_away():
    assert topics.POSE in fenced(0.0).gate.reads
    rig = fenced(0.0).driving(speed=0.2)
    assert rig.out.speeds[0] == pytest.approx(0.2)
    rig.place = (0.62, 0.0, 0.0)
    rig.tick()
    assert 0.0 < rig.out.speed_limit < 0.2
    rig.place = (0.7, 0.0, 0.0)
    rig.tick(60)
    assert (rig.out.speeds[0], rig.out.reasons) == (0.0, (Reason.OWN_CHECK,))
    assert "room: the fence is ahead" in rig.trips[-1].text
    rig.place = (1.5, 0.0, math.pi)
    rig.tick(60)
    assert rig.out.speeds[0] == pytest.approx(0.2), "from outside back to it"


def test_without_a_pose_the_truck_stands():
    rig = fenced(0.0)
    rig.place = None
    rig.armed()
    rig.driver = {"speed": 0.2}
    rig.tick(10)
    assert rig.out.speeds[0] == 0.0
    assert rig.out.reasons == (Reason.OWN_CHECK,)
