"""The goal service before it runs."""

from types import SimpleNamespace

import pytest

from monstertruck_planners.goals.service import GoalService
from monstertruck_runtime.errors import RequestRefusedError
from monstertruck_schemas.reasons import Reason


@pytest.mark.parametrize(
    ("actor", "reason", "text"),
    [(None, Reason.PLANNER_STARTING, "the planner is starting"), (object(), Reason.NO_MAP, "no pose yet")],
)
def test_a_goal_that_comes_too_early_is_refused_by_what_is_missing(
    actor: object, reason: Reason, text: str, monkeypatch: pytest.MonkeyPatch
):
    service = GoalService.__new__(GoalService)
    monkeypatch.setattr(service, "_examine", lambda *_, **__: None)
    service._actor = actor
    service._in = SimpleNamespace(pose=SimpleNamespace(latest=None))
    with pytest.raises(RequestRefusedError, match=text) as refused:
        service.take(None)
    assert refused.value.refusal is reason


def test_a_running_behaviour_excludes_a_goal_and_lets_one_be_cancelled(monkeypatch: pytest.MonkeyPatch):
    service = GoalService.__new__(GoalService)
    monkeypatch.setattr("monstertruck_planners.goals.service.refusal", lambda *_: Reason.OK)
    running = SimpleNamespace(running=True, behaviour="wall", source="ann")
    service._in = SimpleNamespace(behaviour=SimpleNamespace(latest=running), gate=SimpleNamespace(latest=None))
    service._sequences, service._max_age = {"goal": None}, 0.5
    service._clock = SimpleNamespace(now=lambda: 0)
    with pytest.raises(RequestRefusedError, match="the behaviour wall of ann is running") as refused:
        service._examine(None, "goal", moves=True)
    assert refused.value.refusal is Reason.BUSY
    service._examine(None, "goal", moves=False)
    running.running = False
    service._examine(None, "goal", moves=True)
