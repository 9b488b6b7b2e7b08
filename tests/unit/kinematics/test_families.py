"""Drive families by name."""

import pytest

from monstertruck_kinematics.elementary import KinematicsError
from monstertruck_kinematics.families import FAMILIES, build_drive, parameters_of
from monstertruck_kinematics.steered import FourWheelSteer, Tricycle
from monstertruck_kinematics.unsteered import SkidSteer


@pytest.mark.parametrize("kind", FAMILIES)
def test_every_family_builds_stands_and_knows_its_wheels(kind):
    drive = build_drive(kind)
    standing = (0.0,) * len(drive.inputs)
    assert drive.forward(standing) == pytest.approx((0.0, 0.0, 0.0))
    assert len(drive.wheels(standing)) >= 2
    assert parameters_of(kind)


def test_parameters_reach_the_robot():
    truck = build_drive("truck", wheelbase=0.4, cg_split=0.25, radius=0.08)
    assert isinstance(truck, FourWheelSteer)
    assert (truck.geometry.l_f, truck.radius) == (0.1, 0.08)
    assert build_drive("tricycle", driven="rear") == Tricycle(driven="rear")
    assert build_drive("skid_steer", half_track=0.1) == SkidSteer(0.021, 0.1, -0.1)
    assert len(build_drive("independent", track=1.0).wheels((0.0,) * 8)) == 4
    assert parameters_of("differential") == {"radius": 0.1, "track": 0.3}


def test_typos_are_named():
    with pytest.raises(KinematicsError, match="family 'hovercraft': expected one of truck, ackermann"):
        build_drive("hovercraft")
    with pytest.raises(KinematicsError, match="truck: no parameter weelbase: expected one of wheelbase"):
        build_drive("truck", weelbase=0.3)
    with pytest.raises(KinematicsError, match=r"bicycle: driven is 1\.0: expected something like 'rear'"):
        build_drive("bicycle", driven=1.0)
    with pytest.raises(KinematicsError, match="omni: circle is 'big'"):
        build_drive("omni", circle="big")
    with pytest.raises(KinematicsError, match="wheelbase is -1"):
        build_drive("truck", wheelbase=-1.0)
