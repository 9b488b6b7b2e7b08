from monstertruck_drivers.thresholds import Dwell, Threshold, ThresholdAlarm
from monstertruck_runtime.clock import SECOND


def test_a_dwell_needs_its_time_without_a_break():
    dwell = Dwell(2.0)
    assert [dwell.update(t * SECOND, True) for t in range(4)] == [False, False, True, True]
    assert not dwell.update(4 * SECOND, False)
    assert not dwell.update(5 * SECOND, True)


def test_too_much_begins_after_its_dwell_and_ends_below_the_margin():
    alarm = ThresholdAlarm(Threshold(80.0, 70.0, after=1.0))
    values = [81.0, 79.0, 81.0, 81.0, 75.0, 70.0, 75.0]
    changed = [alarm.update(t * SECOND, value) for t, value in enumerate(values)]
    assert changed == [False, False, False, True, False, True, False]
    assert not alarm.active


def test_too_little():
    alarm = ThresholdAlarm(Threshold(10.0, 20.0))
    states = []
    for t, value in enumerate([10.0, 9.0, 15.0, 20.0, 15.0]):
        alarm.update(t, value)
        states.append(alarm.active)
    assert states == [False, True, True, False, False]


def test_without_a_value_nothing_changes():
    alarm = ThresholdAlarm(Threshold(80.0, 70.0))
    assert not alarm.update(0, None)
    alarm.update(1, 90.0)
    assert not alarm.update(2, None)
    assert alarm.active
