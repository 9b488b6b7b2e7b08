"""What a log tells of goals beforehand."""

import numpy as np
import pytest

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.plan import GoalPhase, GoalState, Path
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import GoalOrder
from monstertruckd.tools.replay_check.goals import GoalRecord, GoalReport, RecordedCall

PERIOD = SECOND // 10
GOAL = Pose2D(x=1.0, y=2.0, yaw=0.0)


def record(*rows, asked=(), planner_requests=()):
    """``rows``: seconds, number, phase, and other fields of a report."""
    reports = []
    for sequence, (seconds, number, phase, *rest) in enumerate(rows):
        stamp = round(seconds * SECOND)
        fields = {"goal": GOAL, "source": "me", "outcome": Reason.DRIVING} | (rest[0] if rest else {})
        reports.append(
            GoalReport(sequence, GoalState(stamp=stamp, received=stamp, seq=0, number=number, phase=phase, **fields))
        )
    return GoalRecord(
        reports,
        planner_requests=[round(at * SECOND) for at in planner_requests],
        asked=[round(at * SECOND) for at in asked],
    )


def test_ticks_that_left_nothing_lie_on_the_grid_of_those_that_did():
    log = record(
        (1.0, 0, GoalPhase.IDLE),
        (3.0, 1, GoalPhase.PLANNING),
        (3.5, 1, GoalPhase.DRIVING),
        (4.0, 1, GoalPhase.IDLE),
        asked=[2.95],
        planner_requests=[3.1, 3.1000001, 3.3],
    )
    assert log.start == SECOND
    assert [tick / SECOND for tick in log.ticks(PERIOD)] == [1.0, 3.0, 3.1, 3.3, 3.5, 4.0]
    unseen = [tick / SECOND for tick in log.unseen_ticks(PERIOD)]
    assert unseen == pytest.approx([3.2, 3.4, 3.6, 3.7, 3.8, 3.9])  # none before there was a goal


def test_a_tick_begins_with_its_path_which_is_published_before_the_report():
    log = record((3.0, 1, GoalPhase.DRIVING), (3.4, 1, GoalPhase.IDLE))
    poses = {"poses": np.zeros(6), "directions": np.ones(2)}
    for name, seconds in (("goal-1-deformed.2", 3.394), ("halt-1.3", 3.395), ("halt-1.4", 3.397), ("goal-1.5", 3.2)):
        stamp = round(seconds * SECOND)
        log.paths.append(Path(stamp=stamp, received=stamp, seq=0, frame="map", name=name, **poses))
    assert [tick / SECOND for tick in log.ticks(PERIOD)] == [3.0, 3.395]
    assert [tick / SECOND for tick in log.unseen_ticks(PERIOD)] == pytest.approx([3.095, 3.195, 3.295])


def test_a_tick_that_reported_nothing_came_before_a_report_was_due():
    log = record((3.0, 1, GoalPhase.DRIVING), (3.603, 1, GoalPhase.DRIVING))
    assert [tick / SECOND for tick in log.unseen_ticks(PERIOD)] == pytest.approx([3.103, 3.203, 3.303, 3.403, 3.5])
    assert max(log.unseen_ticks(PERIOD)) < 3.5 * SECOND


def test_calls_show_in_the_reports_they_caused():
    cancelled = {"outcome": Reason.CANCELLED, "text": "cancelled by you"}
    log = record(
        (1.0, 0, GoalPhase.IDLE),
        (2.0, 1, GoalPhase.PLANNING),
        (2.5, 1, GoalPhase.DRIVING),
        (3.0, 1, GoalPhase.PAUSED),
        (4.0, 1, GoalPhase.PLANNING),
        (5.0, 1, GoalPhase.IDLE, cancelled),
        (6.0, 2, GoalPhase.PLANNING),
        (7.0, 2, GoalPhase.IDLE, {"outcome": Reason.CANCELLED, "text": "the tracker follows another path"}),
    )
    assert log.calls(PERIOD) == {
        1: RecordedCall("me", "base", GOAL),
        3: RecordedCall("me", "base", GoalOrder.PAUSE),
        4: RecordedCall("me", "base", GoalOrder.RESUME),
        5: RecordedCall("you", "base", GoalOrder.CANCEL),
        6: RecordedCall("me", "base", GOAL),
    }
    assert not log.unknown_waypoints(PERIOD)


def test_what_came_by_topic_is_no_call():
    rows = (1.0, 0, GoalPhase.IDLE), (2.0, 1, GoalPhase.PLANNING, {"waypoints": 2})
    assert record(*rows, asked=[1.93]).calls(PERIOD) == {}
    assert not record(*rows, asked=[1.93]).unknown_waypoints(PERIOD)
    assert list(record(*rows, asked=[1.5]).calls(PERIOD)) == [1]
    assert record(*rows).unknown_waypoints(PERIOD)


def test_an_answer_counted_when_the_goal_was_no_longer_being_planned():
    log = record(
        (2.0, 1, GoalPhase.PLANNING),
        (2.5, 1, GoalPhase.PLANNING),
        (2.7, 1, GoalPhase.PLANNING, {"recoveries": 1}),
        (3.1, 1, GoalPhase.DRIVING, {"routes": 1}),
    )
    answers = []
    for log.replayed in range(4):
        answers.append(log.decided())
    assert answers == [round(2.7 * SECOND), round(2.7 * SECOND), round(3.1 * SECOND), None]
