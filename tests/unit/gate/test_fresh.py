"""A sensor whose staleness only the configuration names stops the truck."""

import pytest
from pydantic import ValidationError

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order
from monstertruck_schemas.sensor import Imu, Vector3
from monstertruckd.gate.catalog import FreshConfig
from tests.unit.gate.rig import Rig, header, make_gate


def rig_with(within=None):
    """A truck with an inertial unit, which delivers as its other sensors do."""
    rig = Rig()
    rig.gate = make_gate(own={"unit": FreshConfig(kind="fresh", topic="sensor/imu", within=within)})
    sense, zero = rig.sense, Vector3(x=0.0, y=0.0, z=0.0)

    def sensed():
        sense()
        if "imu" not in rig.silent:
            rig.gate.observe(Imu(**header(rig.now), angular_velocity=zero, linear_acceleration=zero), topics.IMU)

    rig.sense = sensed
    return rig


@pytest.mark.parametrize(("within", "limit"), [(None, topics.IMU.stale_after), (0.4, 0.4)])
def test_a_silent_topic_stops_the_truck(within, limit):
    rig = rig_with(within).driving(speed=0.1)
    assert topics.IMU in rig.gate.reads
    rig.silent.add("imu")
    begin = rig.now
    while not rig.trips and rig.now < begin + SECOND:
        rig.tick()
    cause = rig.trips[-1].causes[0]
    assert (cause.reason, cause.text) == (Reason.OWN_CHECK, "unit: sensor/imu is silent")
    assert (rig.now - begin) / SECOND == pytest.approx(limit, abs=0.03)
    assert cause.measurements[0].limit == limit


def test_a_truck_whose_topic_was_never_heard_is_not_armed():
    rig = rig_with()
    rig.silent.add("imu")
    rig.tick(2)
    assert rig.decide(Order.ARM).text.startswith("unit: sensor/imu is silent")


@pytest.mark.parametrize(
    ("topic", "text"),
    [
        ("sensor/imuu", "expected a topic of the robot"),
        ("req/goal", "expected a topic of the robot"),
        ("event/event", "has no staleness limit; set `within`"),
    ],
)
def test_a_topic_that_cannot_be_stale_is_refused(topic, text):
    with pytest.raises(ValidationError, match=text):
        FreshConfig(kind="fresh", topic=topic)
