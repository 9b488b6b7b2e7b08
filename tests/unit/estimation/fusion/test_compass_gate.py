import math

import pytest

from monstertruck_estimation.fusion.config import WheelTrust
from monstertruck_estimation.fusion.filter import NORTH
from tests.unit.estimation.fusion.kit import FIELD, Rig, attitude

SENSORS = ("wheels", "compass")


def disturbed(rig, seconds, **what):
    kept = {name: getattr(rig, name) for name in what}
    for name, value in what.items():
        setattr(rig, name, value)
    rig.drive(0.3, 0.0, 0.0, seconds)
    for name, value in kept.items():
        setattr(rig, name, value)
    return rig


def test_north_is_found_whatever_it_is():
    rig = Rig(SENSORS)
    rig.north = -2.0
    rig.drive(0.3, 0.0, 0.0, 3.0)
    assert rig.fusion.status().north == pytest.approx(-2.0, abs=0.02)


def test_a_magnet_that_changes_the_field_is_left_out_at_once_and_comes_back():
    rig = Rig(SENSORS).drive(0.3, 0.0, 0.0, 4.0)
    disturbed(rig, 3.0, magnet=0.1, field=FIELD * 1.4)
    assert rig.fusion.status().disturbed
    assert "compass" not in rig.estimate.sources
    assert rig.error()[1] < 0.02
    rig.drive(0.3, 0.0, 0.0, 8.0)
    assert not rig.fusion.status().disturbed
    assert "compass" in rig.estimate.sources


def test_a_field_that_fades_does_not_creep_in():
    rig = Rig(SENSORS).drive(0.3, 0.0, 0.0, 4.0)
    for k in range(30):
        disturbed(rig, 0.1, magnet=0.6 * k / 30, field=FIELD * (1 + k / 30))
    for k in range(30, 0, -1):
        disturbed(rig, 0.1, magnet=0.6 * k / 30, field=FIELD * (1 + k / 30))
    assert rig.error()[1] < 0.06, "no more than what the field does not betray: 5 % of its strength, 0.03 rad"


def test_a_jump_of_the_heading_alone_is_left_out():
    rig = Rig(SENSORS).drive(0.3, 0.0, 0.0, 4.0)
    disturbed(rig, 3.0, magnet=0.7)
    assert rig.fusion.status().disturbed
    assert rig.error()[1] < 0.02
    rig.drive(0.3, 0.0, 0.0, 8.0)
    assert not rig.fusion.status().disturbed


def test_a_heading_that_is_right_only_in_passing_is_not_believed_again():
    """As beside a magnet, where the deviation changes its sign."""
    rig = Rig(SENSORS).drive(0.3, 0.0, 0.0, 4.0)
    for k in range(60):
        disturbed(rig, 0.1, magnet=0.6 - 1.2 * k / 60)
        assert rig.fusion.status().disturbed
    assert rig.error()[1] < 0.05


def test_headings_before_a_disturbance_was_noticed_are_not_believed():
    rig = Rig(SENSORS).drive(0.3, 0.0, 0.0, 4.0)
    for k in range(12):
        disturbed(rig, 0.1, magnet=0.02 * k)
    crept = rig.fusion.state.mean[2]
    assert not rig.fusion.status().disturbed
    disturbed(rig, 0.1, magnet=0.24, field=FIELD * 1.1)
    assert rig.fusion.status().disturbed
    rig.settle()
    assert abs(rig.fusion.state.mean[2]) < 0.5 * abs(crept)


def test_a_magnet_that_is_approached_slowly_is_taken_back_to_where_it_began():
    """A dipole 2.4 m ahead and to the side: for two metres the field's strength hardly changes, the heading does."""
    rig = Rig(SENSORS, wheels=WheelTrust(trim=0.01)).drive(0.3, 0.0, 0.0, 3.0)
    crept = 0.0
    while not rig.fusion.status().disturbed:
        share = 0.05 / (2.4 + 0.9 - rig.pose[0]) ** 3
        crept = rig.error()[1]
        disturbed(rig, 0.1, magnet=3.5 * share, field=FIELD * (1 + share))
    assert crept > 0.03
    rig.field = FIELD * 1.5
    rig.drive(0.3, 0.0, 0.0, 1.5)
    assert rig.fusion.waiting == 0
    assert rig.error()[1] < 0.2 * crept


def test_what_is_taken_back_still_tells_how_strong_the_field_is():
    rig = Rig(SENSORS).drive(0.3, 0.0, 0.0, 2.0)
    disturbed(rig, 2.0, magnet=0.5, field=FIELD * 1.3)
    assert rig.fusion.waiting == 0
    assert rig.fusion.state.gate.field == pytest.approx(FIELD)


def test_headings_from_one_place_err_alike():
    """A minute of readings on one spot tells no more than that spot: 3 degrees."""
    rig = Rig(SENSORS).drive(0.0, 0.0, 0.0, 20.0)
    assert math.sqrt(rig.fusion.state.covariance[NORTH, NORTH]) > 0.045


def test_a_disturbance_that_the_strength_hides_moves_the_deviation_more_than_the_yaw():
    rig = Rig(SENSORS, wheels=WheelTrust(trim=0.01)).drive(0.3, 0.0, 0.0, 4.0)
    for k in range(20):
        disturbed(rig, 0.1, magnet=0.01 * k)
    assert rig.error()[1] < 0.5 * 0.2


def test_a_single_good_heading_is_not_enough_to_be_believed_again():
    rig = Rig(SENSORS).drive(0.3, 0.0, 0.0, 4.0)
    disturbed(rig, 1.0, magnet=0.7)
    disturbed(rig, 0.06)
    assert rig.fusion.status().disturbed


def test_a_lasting_change_becomes_a_new_north_and_the_old_one_is_known_again():
    # With scans, for by the wheels alone the yaw would become so uncertain that it might as well be wrong.
    rig = Rig(("wheels", "compass", "scans")).drive(0.3, 0.0, 0.0, 4.0)
    disturbed(rig, 9.0, magnet=0.7)
    assert rig.fusion.status().disturbed
    disturbed(rig, 3.0, magnet=0.7)
    assert not rig.fusion.status().disturbed
    assert rig.fusion.status().north == pytest.approx(0.0, abs=0.1)
    assert rig.error()[1] < 0.05
    rig.drive(0.3, 0.0, 0.0, 8.0)
    assert not rig.fusion.status().disturbed
    assert rig.fusion.status().north == pytest.approx(0.7, abs=0.05)
    assert rig.error()[1] < 0.05


@pytest.mark.parametrize(("sensors", "magnet"), [(SENSORS, 0.3), ((*SENSORS, "imu"), 0.12)])
def test_headings_that_jump_for_good_never_draw_the_yaw_along(sensors, magnet):
    """By wheels alone the yaw soon is so uncertain that the jump might as well be the robot's: it is remembered."""
    rig = Rig(sensors).drive(0.0, 0.0, 0.0, 1.0).drive(0.3, 0.0, 0.0, 4.0)
    rig.magnet = magnet
    rig.drive(0.3, 0.0, 0.0, 8.0)
    assert "jumped by +0." in rig.fusion.status().doubt
    assert rig.error()[1] < 0.03
    rig.drive(0.3, 0.0, 0.0, 5.0)
    assert not rig.fusion.status().disturbed
    assert rig.fusion.status().north == pytest.approx(0.7 - magnet, abs=0.05)
    assert rig.error()[1] < 0.03


def test_headings_that_jump_back_are_believed_again():
    rig = Rig(SENSORS).drive(0.3, 0.0, 0.0, 4.0)
    disturbed(rig, 3.0, magnet=0.3)
    assert "jumped" in rig.fusion.status().doubt
    rig.drive(0.3, 0.0, 0.0, 8.0)
    assert not rig.fusion.status().disturbed
    assert rig.fusion.status().north == pytest.approx(0.7, abs=0.03)


def test_headings_that_turn_no_faster_than_the_robot_can_are_no_jump():
    """Its wheels may have slipped."""
    rig = Rig(SENSORS).drive(0.3, 0.0, 0.0, 4.0)
    for k in range(10):
        disturbed(rig, 0.1, magnet=0.03 * k)
        assert "jumped" not in (rig.fusion.status().doubt or "")
    assert rig.fusion.status().slipping


@pytest.mark.parametrize(("speed", "sticks"), [(0.3, False), (0.0, True)])
def test_started_beside_iron_the_field_of_where_it_drives_replaces_that_of_the_start(speed, sticks):
    """Its heading there is wrong, too; one that only stands beside iron learns nothing from it."""
    rig = Rig((*SENSORS, "imu"))
    rig.field, rig.magnet = 1.5 * FIELD, 0.4
    rig.drive(0.0, 0.0, 0.0, 2.0)
    rig.field, rig.magnet = FIELD, 0.0
    rig.drive(speed, 0.0, 0.0, 12.0)
    assert rig.fusion.status().disturbed
    rig.drive(speed, 0.0, 0.0, 10.0)
    assert rig.fusion.status().disturbed is sticks
    assert rig.fusion.status().north == pytest.approx(0.3 if sticks else 0.7, abs=0.06)
    assert rig.error()[1] < 0.04


def test_wild_headings_never_become_a_north():
    rig = Rig(SENSORS).drive(0.3, 0.0, 0.0, 4.0)
    for _ in range(150):
        disturbed(rig, 0.1, magnet=float(rig.rng.uniform(0.5, 5.5)))
    assert rig.fusion.status().disturbed
    assert rig.error()[1] < 0.05


def test_the_devices_own_word_counts():
    rig = Rig(SENSORS).drive(0.3, 0.0, 0.0, 4.0)
    before = rig.fusion.state.mean[2]
    for k in range(40):
        rig.fusion.observe_attitude(attitude(rig.now + k + 1, math.pi / 2, heading_disturbed=True))
    assert rig.fusion.state.mean[2] == pytest.approx(before, abs=0.02)
    assert rig.fusion.status().disturbed


def test_the_deviation_of_the_compass_does_not_count_as_slip():
    rig = Rig(SENSORS).drive(0.3, 0.2, -0.2, 4.0)
    disturbed(rig, 2.0, magnet=0.7, field=FIELD * 1.5)
    assert rig.drive(0.3, 0.2, -0.2, 4.0).changes == []


def test_a_compass_of_the_wrong_sign_is_left_out_however_slowly_it_turns():
    rig = Rig(("wheels", "compass"))
    rig.drive(0.0, 0.0, 0.0, 0.5)
    for _ in range(40):
        rig.drive(0.3, 0.05, -0.05, 0.1)
        rig.magnet = -2.0 * rig.pose[2]
    assert "check the compass's sign" in rig.fusion.status().doubt
    assert rig.error()[1] < 3 * math.sqrt(rig.estimate.pose_covariance[8])
