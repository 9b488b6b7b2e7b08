import math
from itertools import combinations

import numpy as np
import pytest

from monstertruck_estimation.fusion import estimator
from monstertruck_estimation.fusion.config import SlipConfig
from monstertruck_estimation.fusion.estimator import MAX_RECOMPUTED, Fusion
from monstertruck_estimation.inertial import Inertial
from monstertruck_estimation.transforms import IDENTITY
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.sensor import Vector3
from tests.unit.estimation.fusion.kit import ALL, TICK, Rig, attitude, config, imu, scan_motion, wander
from tests.unit.estimation.kit import CHASSIS, drive_feedback, servo_feedback

NAMES = {"wheels": {"drive", "steering"}, "compass": {"compass", "tilt"}, "scans": {"lidar"}}
SUBSETS = [subset for size in (1, 2, 3) for subset in combinations(ALL, size)]


@pytest.mark.parametrize("sensors", SUBSETS, ids="+".join)
def test_any_subset_gives_an_estimate_that_names_it(sensors):
    rig = wander(Rig(sensors), seconds=6)
    assert set(rig.estimate.sources) == set().union(*(NAMES[sensor] for sensor in sensors))
    assert np.isfinite(rig.estimate.pose).all()
    assert np.linalg.eigvalsh(rig.estimate.pose_covariance.reshape(3, 3))[0] > 0
    if sensors != ("compass",):
        assert rig.error()[0] < 0.25
    if "compass" in sensors:
        assert rig.error()[1] < 0.1


def test_more_sensors_err_less():
    def rms(sensors):
        errors = [wander(Rig(sensors, seed=seed), seconds=8).error()[0] for seed in range(2)]
        return math.sqrt(np.mean(np.square(errors)))

    wheels, held, everything = rms(("wheels",)), rms(("wheels", "compass")), rms(ALL)
    assert everything < 0.5 * held
    assert everything < 0.5 * wheels


def test_the_errors_are_as_great_as_the_covariance_says():
    """Bar-Shalom's consistency test: the mean NEES of 8 runs of 3 degrees of freedom lies in its 99.9 % bounds."""
    runs = np.array([wander(Rig(ALL, seed=seed), seconds=6).nees()[-1] for seed in range(8)])
    assert runs.mean() < 3 * (1 + 3.3 * math.sqrt(2 / (3 * 8)))
    assert runs.mean() > 0.3, "much too modest"


def test_an_imu_holds_the_heading_that_wheels_alone_lose():
    errors = []
    for sensors in (("wheels",), ("wheels", "imu")):
        rig = Rig(sensors).drive(0.0, 0.0, 0.0, 0.6)
        rig.crooked = 0.04
        errors.append(rig.drive(0.3, 0.1, -0.1, 4.0).error()[1])
    assert "imu" in rig.estimate.sources
    assert errors[1] < 0.03 < 0.15 < errors[0]
    assert errors[1] < 4 * math.sqrt(rig.estimate.pose_covariance[8])


@pytest.mark.parametrize("share", [-1.0, 0.0], ids=["wrong sign", "stuck"])
def test_an_imu_that_turns_against_the_wheels_is_left_out(share):
    rig = Rig(("wheels", "imu")).drive(0.0, 0.0, 0.0, 1.0)
    rig.gyro = share
    rig.drive(0.3, 0.2, -0.2, 4.0)
    assert "imu" not in rig.estimate.sources
    assert rig.error()[1] < 0.1, "what it reported before it was noticed is taken back"
    rig.drive(0.0, 0.0, 0.0, 1.0)
    assert "imu" not in rig.estimate.sources


def test_an_imu_whose_bias_creeps_away_is_left_out_and_not_believed_more_than_it_is_worth():
    rig = Rig(("wheels", "imu", "compass")).drive(0.0, 0.0, 0.0, 1.0)
    begun, gyro = rig.now, rig.inertial.gyro
    observe = rig.inertial.observe
    rig.inertial.observe = lambda one: observe(
        one.model_copy(update={"angular_velocity": Vector3(x=0.0, y=0.0, z=one.angular_velocity.z + drifted())})
    )

    def drifted():
        return 2e-3 * (rig.now - begun) / SECOND

    rig.drive(0.2, 0.0, 0.0, 22.0)
    assert (gyro.trusted, "imu" in rig.estimate.sources) == (False, False)
    assert rig.error()[1] < 4 * math.sqrt(rig.estimate.pose_covariance[8])


def test_wheels_that_slip_do_not_make_an_imu_suspect_and_the_heading_goes_by_it():
    rig = Rig(("wheels", "imu", "scans")).drive(0.0, 0.0, 0.0, 0.6).drive(0.2, 0.2, -0.2, 1.0)
    rig.slip = 2.5
    rig.drive(0.2, 0.2, -0.2, 2.5)
    assert [change.slipping for change in rig.changes] == [True]
    assert rig.inertial.gyro.trusted
    assert "imu" in rig.estimate.sources
    assert rig.error()[1] < 0.06


def test_on_a_slope_the_tilt_by_the_imu_shortens_the_way():
    ways = []
    for slope in (0.0, 0.4):
        rig = Rig(("wheels",))
        rig.fusion = Fusion(config(), CHASSIS, unit := Inertial(config().imu, IDENTITY))
        for _ in range(200):
            unit.observe(imu(rig.now, force=(-9.81 * math.sin(slope), 0.0, 9.81 * math.cos(slope))))
            rig.drive(0.3, 0.0, 0.0, 0.01)
        assert "tilt" in rig.estimate.sources
        ways.append(rig.estimate.pose[0])
    assert ways[1] == pytest.approx(ways[0] * math.cos(0.4), rel=0.01)


def test_a_corridor_does_not_collapse_what_the_wheels_say_along_it():
    rig = Rig(("wheels", "scans"))
    rig.degenerate = 0.0
    rig.drive(0.3, 0.0, 0.0, 20.0)
    wheels = Rig(("wheels",)).drive(0.3, 0.0, 0.0, 20.0)
    along, across = np.sqrt(rig.estimate.pose_covariance[[0, 4]])
    assert along > 0.8 * math.sqrt(wheels.estimate.pose_covariance[0])
    assert across < 0.7 * math.sqrt(wheels.estimate.pose_covariance[4])
    assert rig.error()[0] < 4 * max(along, across)


def test_a_trim_of_the_steering_is_learned():
    learned, blind = Rig(ALL), Rig(("wheels",))
    for rig in (learned, blind):
        rig.crooked = 0.01
        rig.drive(0.3, 0.0, 0.0, 15.0)
    assert learned.fusion.status().trim == pytest.approx(2 * math.tan(0.01) / 0.32, abs=0.02)
    learned.sensors = {"wheels"}
    turned, off = learned.error()[1], blind.error()[1]
    for rig in (learned, blind):
        rig.drive(0.3, 0.0, 0.0, 5.0)
    assert abs(learned.error()[1] - turned) < 0.3 * (blind.error()[1] - off)


def test_the_pose_never_jumps_though_slip_is_corrected():
    rig = Rig(ALL).drive(0.3, 0.1, -0.1, 4.0)
    rig.slip = 1.8
    rig.drive(0.3, 0.1, -0.1, 1.5)
    rig.slip = 1.0
    rig.drive(0.3, 0.1, -0.1, 4.0)
    assert rig.steps().max() < (0.3 * 1.8 + 0.5) / 50 + 1e-3
    assert [change.slipping for change in rig.changes] == [True, False]
    assert "wheels and scans differ by" in rig.changes[0].text


def test_slip_that_the_scans_show_costs_little():
    def error(sensors):
        rig = Rig(sensors).drive(0.3, 0.1, -0.1, 4.0)
        rig.slip = 1.8
        rig.drive(0.3, 0.1, -0.1, 1.5)
        rig.slip = 1.0
        return rig.drive(0.3, 0.1, -0.1, 2.0).error()[0]

    assert error(ALL) < 0.05
    assert error(("wheels",)) > 0.2


@pytest.mark.parametrize("trouble", ["slip", "magnet"])
def test_no_call_redoes_more_than_a_few_readings(trouble, monkeypatch):
    """At the onset of slip, or of a disturbance, a second and a half of readings is redone: over several estimates."""
    calls, spent, waited = [], [], []
    advance = estimator.apply_measurement
    monkeypatch.setattr(
        estimator, "apply_measurement", lambda *given, **more: calls.append(1) or advance(*given, **more)
    )
    rig = Rig(ALL)
    for name in ("observe_drive", "observe_attitude", "observe_scan", "estimate"):
        call = getattr(rig.fusion, name)

        def counted(*given, call=call):
            calls.clear()
            result = call(*given)
            spent.append(len(calls))
            waited.append(rig.fusion.waiting)
            return result

        monkeypatch.setattr(rig.fusion, name, counted)
    rig.drive(0.3, 0.0, 0.0, 3.0)
    setattr(rig, trouble, 1.8)
    rig.drive(0.3, 0.0, 0.0, 2.0)
    assert max(waited) > 2 * MAX_RECOMPUTED, "there was more to redo than one call may"
    assert max(spent) <= MAX_RECOMPUTED
    assert waited[-1] <= MAX_RECOMPUTED


def test_wheels_that_slip_do_not_count_as_a_source():
    rig = Rig(ALL).drive(0.3, 0.0, 0.0, 4.0)
    rig.slip = 1.8
    rig.drive(0.3, 0.0, 0.0, 2.5)
    assert rig.fusion.status().slipping
    assert "drive" not in rig.estimate.sources
    assert "lidar" in rig.estimate.sources


def test_slip_that_nothing_can_confirm_any_longer_is_over():
    """The lidar is gone, and the wheels are all there is."""
    rig = Rig(("wheels", "scans")).drive(0.3, 0.0, 0.0, 2.0)
    rig.slip = 1.8
    rig.drive(0.3, 0.0, 0.0, 1.0)
    rig.slip, rig.sensors = 1.0, {"wheels"}
    rig.drive(0.3, 0.0, 0.0, 8.0)
    assert rig.fusion.status().slipping
    rig.drive(0.3, 0.0, 0.0, 3.0)
    assert not rig.fusion.status().slipping
    assert "drive" in rig.estimate.sources
    assert "no other motion measurement" in rig.changes[-1].text


def test_slip_too_slight_for_one_window_is_clear_over_two():
    rig = Rig(("wheels", "scans"), slip=SlipConfig(window=0.2)).drive(0.3, 0.0, 0.0, 4.0)
    rig.slip = 1.6
    rig.drive(0.3, 0.0, 0.0, 1.0)
    assert [change.slipping for change in rig.changes] == [True]
    assert "in 0.4 s" in rig.changes[0].text
    rig.slip = 1.0
    rig.drive(0.3, 0.0, 0.0, 3.0)
    assert [change.slipping for change in rig.changes] == [True, False], "what is past is settled"


def test_good_wheels_never_count_as_slipping():
    for seed in range(2):
        assert wander(Rig(ALL, seed=seed), seconds=12).changes == []


@pytest.mark.parametrize("blind", ["degenerate", "silent"])
def test_scans_that_go_along_with_the_robot_after_they_were_blind_are_doubted(blind):
    """As the ground ahead does behind a crest."""
    rig = Rig(("wheels", "scans")).drive(0.3, 0.0, 0.0, 3.0)
    if blind == "degenerate":
        rig.degenerate = 0.0
    else:
        rig.sensors, rig.last = {"wheels"}, None
    rig.drive(0.3, 0.0, 0.0, 0.5)
    rig.sensors, rig.degenerate, rig.seen = {"wheels", "scans"}, None, 0.0
    rig.drive(0.3, 0.0, 0.0, 3.0)
    assert rig.changes == []
    assert rig.error()[0] < 0.15
    assert rig.fusion.status().left_out["lidar: contradicts the wheels right after a gap"] > 20
    rig.seen = 1.0
    rig.drive(0.3, 0.0, 0.0, 2.0)
    rig.slip = 1.8
    rig.drive(0.3, 0.0, 0.0, 1.5)
    assert [change.slipping for change in rig.changes] == [True], "they agreed again, so they are a witness again"


def test_scans_that_have_seen_all_along_are_believed_when_they_stand():
    rig = Rig(("wheels", "scans")).drive(0.3, 0.0, 0.0, 3.0)
    rig.seen = 0.0
    rig.drive(0.3, 0.0, 0.0, 1.0)
    assert [change.slipping for change in rig.changes] == [True]


def test_a_turn_that_only_the_wheels_make_is_slip_by_the_compass():
    rig = Rig(("wheels", "compass")).drive(0.3, 0.0, 0.0, 4.0)
    rig.crooked = 0.3
    rig.drive(0.3, 0.0, 0.0, 3.0)
    assert [change.slipping for change in rig.changes] == [True]
    assert "compass" in rig.changes[0].text
    assert rig.error()[1] < 0.25


def test_a_sensor_that_falls_silent_is_done_without():
    rig = Rig(ALL).drive(0.3, 0.1, -0.1, 4.0)
    rig.sensors = {"compass", "scans"}
    rig.drive(0.3, 0.1, -0.1, 4.0)
    assert rig.estimate.sources == ("compass", "tilt", "lidar")
    assert rig.error()[0] < 0.08
    rig.sensors = {"compass"}
    there = rig.estimate.pose
    rig.drive(0.0, 0.0, 0.0, 4.0)
    assert rig.estimate.sources == ("compass", "tilt")
    assert math.dist(there[:2], rig.estimate.pose[:2]) < 0.3, "the last motion is not carried on for ever"
    assert rig.estimate.age > 3.0


def test_tilt_shortens_the_way_over_a_ramp():
    def way(pitch):
        fusion = Fusion(config(), CHASSIS)
        for k in range(200):
            now = SECOND + k * 5 * TICK
            fusion.observe_steering(servo_feedback(now, 0.0, 0.0))
            fusion.observe_attitude(attitude(now - 1, 0.0, pitch=pitch))
            fusion.observe_drive(drive_feedback(now, k * 100.0))
        return fusion.state.mean[0]

    assert way(-0.3) == pytest.approx(way(0.0) * math.cos(0.3), rel=1e-3)


# Bad input


def test_late_measurements_give_what_punctual_ones_give():
    early, late = Rig(ALL, seed=3), Rig(ALL, seed=3)
    early.delay, late.delay = 0, 60
    for rig in (early, late):
        rig.drive(0.3, 0.1, -0.1, 6.0)
        for motion in rig.waiting:
            rig.fusion.observe_scan(motion)
        rig.waiting.clear()
        rig.settle()
    assert late.fusion.state.mean == pytest.approx(early.fusion.state.mean, abs=1e-9)
    assert late.fusion.state.covariance == pytest.approx(early.fusion.state.covariance, abs=1e-12)


def test_what_is_too_late_is_left_out():
    rig = Rig(("wheels", "compass")).drive(0.3, 0.0, 0.0, 6.0)
    before = rig.fusion.state
    rig.fusion.observe_scan(scan_motion(SECOND, SECOND + 10 * TICK, (0.05, 0.0, 0.0), np.eye(3) * 1e-6))
    assert rig.fusion.state.mean == pytest.approx(before.mean)
    assert rig.fusion.status().left_out == {"lidar: too late": 1}


@pytest.mark.parametrize("step", [0, -SECOND // 2])
def test_duplicates_and_time_that_goes_back_change_nothing(step):
    rig = Rig(ALL).drive(0.3, 0.0, 0.0, 3.0)
    before = rig.fusion.state
    stamp = rig.fusion._last["lidar"] + step
    rig.fusion.observe_drive(drive_feedback(rig.now + step, rig.motor + 100.0))
    rig.fusion.observe_attitude(attitude(rig.fusion._last["compass"] + step, 2.0))
    rig.fusion.observe_scan(scan_motion(stamp - 10 * TICK, stamp, (1.0, 0.0, 0.0), np.eye(3) * 1e-6))
    assert rig.fusion.state is before
    assert sum(rig.fusion.status().left_out.values()) == 3


def test_an_estimate_for_an_earlier_instant_does_not_move_the_pose():
    rig = Rig(ALL).drive(0.3, 0.0, 0.0, 3.0)
    pose = rig.estimate.pose
    assert rig.fusion.estimate(rig.now - SECOND).pose == pytest.approx(pose, abs=0.02)
    assert rig.fusion.estimate(rig.now).pose == pytest.approx(pose, abs=0.02)


def test_what_is_no_number_is_left_out():
    rig = Rig(ALL).drive(0.3, 0.0, 0.0, 3.0)
    before, now = rig.fusion.state, rig.now + TICK
    nan = math.nan
    rig.fusion.observe_drive(drive_feedback(now, 0.0).model_copy(update={"position": nan}))
    rig.fusion.observe_steering(servo_feedback(now, 0.0, 0.0).model_copy(update={"front": nan}))
    for name in ("heading", "roll", "pitch"):
        rig.fusion.observe_attitude(attitude(now, 0.0).model_copy(update={name: nan}))
    good = scan_motion(now - 10 * TICK, now, (0.0, 0.0, 0.0), np.eye(3))
    for covariance in (np.full(9, nan), -np.eye(3).ravel(), np.zeros(9)):
        rig.fusion.observe_scan(good.model_copy(update={"covariance": covariance}))
    rig.fusion.observe_scan(good.model_copy(update={"motion": good.motion.model_copy(update={"x": nan})}))
    rig.fusion.observe_scan(good.model_copy(update={"since": now}))
    assert rig.fusion.state is before
    assert sum(rig.fusion.status().left_out.values()) == 9
    rig.drive(0.3, 0.0, 0.0, 1.0)
    assert rig.error()[0] < 0.05


def test_missing_scans_are_stepped_over():
    rig = Rig(ALL, seed=2).drive(0.3, 0.1, -0.1, 3.0)
    rig.sensors.remove("scans")
    rig.drive(0.3, 0.1, -0.1, 3.0)
    rig.sensors.add("scans")
    rig.drive(0.3, 0.1, -0.1, 1.0)
    assert rig.error()[0] < 0.05
    assert rig.steps().max() < 0.02
    assert "lidar" in rig.estimate.sources


def test_a_drive_that_counts_anew_does_not_move_the_truck():
    rig = Rig(ALL).drive(0.3, 0.0, 0.0, 3.0)
    rig.motor = -1000.0
    rig.drive(0.3, 0.0, 0.0, 2.0)
    assert rig.error()[0] < 0.05
    assert rig.steps().max() < 0.02
    assert rig.fusion.status().left_out == {"drive: position counter restarted": 1}


def test_a_scan_motion_of_nowhere_makes_no_jump():
    rig = Rig(ALL).drive(0.3, 0.0, 0.0, 3.0)
    since, _ = rig.last
    rig.waiting.clear()
    rig.fusion.observe_scan(scan_motion(since, since + 5 * TICK, (3.0, -2.0, 1.0), np.eye(3) * 1e-5))
    rig.drive(0.0, 0.0, 0.0, 0.2)
    assert rig.steps().max() < 0.03


def test_nothing_is_known_before_the_first_reading():
    fusion = Fusion(config(), CHASSIS)
    assert fusion.estimate(SECOND) is None
    assert fusion.state is None
    assert fusion.status().north is None


def test_sections_set_null_leave_sensors_out():
    rig = Rig(ALL, wheels=None, compass=None).drive(0.3, 0.0, 0.0, 3.0)
    assert rig.estimate.sources == ("tilt", "lidar")
    assert rig.error()[0] < 0.08
    rig = Rig(ALL, scans=None).drive(0.3, 0.0, 0.0, 3.0)
    assert "lidar" not in rig.estimate.sources
