"""One exploration: the state machine, and the places that are left alone."""

import math
from dataclasses import replace

import numpy as np
import pytest

from monstertruck_planners.explore import exploration
from monstertruck_planners.explore.config import InformationConfig
from monstertruck_planners.explore.exchange import ExploreAnswer, Viewpoint
from monstertruck_planners.explore.exploration import Attempts, Cancel, Choose, Exploration, Go, Notice, Observed, Save
from monstertruck_schemas.plan import ExplorationPhase as Phase
from monstertruck_schemas.reasons import Reason

STANDS = 5.0
RETURNS = 6
CONFIRM = 2

HOME = (1.0, 2.0, 0.5)
CONFIG = InformationConfig()
FIRST, SECOND = Viewpoint((3.0, 2.0, 0.0), (4.0, 2.0), 2.0, 1.0), Viewpoint((0.0, 5.0, 1.0), (0.0, 6.0), 3.0, 2.0)
NOTHING = ExploreAnswer(known=10.0, home=1.0)


class SteppedExploration:
    """An exploration with given observations."""

    def __init__(self, **more) -> None:
        more = {"home": True, "budget": 1000.0} | more
        self.run, self.actions = exploration.begin(1, "ann", HOME, 0.0, CONFIG, **more)
        self.now, self.pose = 0.0, HOME

    def step(self, seconds: float = 0.2, **seen) -> Exploration:
        self.now += seconds
        observed = Observed(**{"now": self.now, "pose": self.pose} | seen)
        self.run, self.actions = exploration.tick(self.run, observed, CONFIG)
        return self.run

    def said(self) -> list[Reason]:
        return [action.reason for action in self.actions if isinstance(action, Notice)]

    def drive(self, target: Viewpoint = FIRST) -> None:
        self.step()
        assert self.actions == (Choose(),)
        self.step(answer=ExploreAnswer(target, frontiers=2, known=5.0, home=3.0))
        assert self.actions[0] == Go(target.pose)
        assert self.run.phase is Phase.DRIVING

    def look(self, answer: ExploreAnswer) -> None:
        """Wait until it asks, and answer."""
        while Choose() not in self.actions:
            self.step()
            assert self.now < 500
        self.step(answer=answer)

    def exhaust(self) -> None:
        for _ in range(CONFIRM):
            self.look(NOTHING)

    def saved(self) -> Exploration:
        assert self.run.phase is Phase.SAVING
        return self.step(saved="somewhere")


def test_it_looks_drives_looks_again_and_ends_at_home_with_a_saved_map():
    stepped = SteppedExploration()
    stepped.drive()
    stepped.pose = FIRST.pose
    stepped.step(ended=Reason.GOAL_REACHED)
    assert stepped.run.phase is Phase.LOOKING
    assert stepped.run.attempts.banned(stepped.now) == (FIRST.frontier,)
    stepped.exhaust()
    stepped.exhaust()  # the place it came from is looked at once more
    assert (stepped.run.phase, stepped.said()) == (Phase.RETURNING, [Reason.EXPLORED])
    stepped.step()
    assert stepped.actions == (Go(HOME),)
    stepped.step(ended=Reason.GOAL_REACHED)
    assert stepped.actions == (Save(),)
    assert stepped.saved().outcome is Reason.EXPLORED
    assert "back at the start" in stepped.run.text
    assert "somewhere" in stepped.run.text
    assert stepped.run.travelled == pytest.approx(2.0)


def test_while_it_drives_it_goes_on_or_turns_to_another_place():
    stepped = SteppedExploration()
    stepped.drive()
    stepped.step(1.0)
    assert stepped.actions == (Choose(),)
    stepped.step(0.1, answer=ExploreAnswer(FIRST, kept=True, known=6.0))
    assert stepped.actions == ()
    assert stepped.run.newest.home == 3.0  # the last one that was known
    stepped.step(1.0)
    stepped.step(answer=ExploreAnswer(SECOND, known=6.0))
    assert stepped.actions[0] == Go(SECOND.pose)
    stepped.step(1.0)
    stepped.step(answer=ExploreAnswer(known=7.0))
    assert stepped.actions == (Cancel(),)
    assert stepped.run.phase is Phase.LOOKING


def test_a_place_it_cannot_come_to_is_left_alone_for_a_while_and_then_for_good():
    stepped = SteppedExploration()
    for attempt in range(CONFIG.attempts):
        stepped.look(ExploreAnswer(FIRST, known=5.0))
        stepped.step(ended=Reason.GOAL_UNREACHABLE)
        assert stepped.said() == [Reason.GOAL_UNREACHABLE]
        assert stepped.run.failures == attempt + 1
        assert stepped.run.unreached.banned(stepped.now) == (FIRST.pose[:2],)
        # After the first time the frontier may still be looked at from another place.
        assert stepped.run.attempts.banned(stepped.now) == ((FIRST.frontier,) if attempt else ())
        if attempt + 1 < CONFIG.attempts:
            stepped.exhaust()
            assert stepped.said() == [Reason.RECOVERING]
            assert stepped.run.attempts.banned(stepped.now) == ()
    stepped.exhaust()
    assert stepped.said() == [Reason.EXPLORED]


def test_where_no_place_can_be_reached_it_drives_back_and_blames_none_of_them():
    stepped = SteppedExploration()
    for x in (1.0, 1.6, 2.2):
        stepped.pose = (x, 2.0, 0.0)
        stepped.step()
    stepped.run = replace(stepped.run, waiting=False, asked=-math.inf)
    for k in range(exploration.STUCK):
        stepped.look(ExploreAnswer(Viewpoint((5.0 + k, 2.0, 0.0), (6.0 + k, 2.0)), known=5.0))
        stepped.step(ended=Reason.ROUTE_TIMEOUT)
    assert stepped.said() == [Reason.RECOVERING]
    assert stepped.actions[0] == Go((1.6, 2.0, 0.0))
    assert (stepped.run.attempts.places, stepped.run.unreached.places) == ((), ())
    stepped.step(2.0)
    assert Choose() not in stepped.actions, "it drives back first"
    stepped.step(ended=Reason.ROUTE_TIMEOUT)
    assert stepped.run.phase is Phase.LOOKING
    for k in range(exploration.STUCK):
        stepped.look(ExploreAnswer(Viewpoint((5.0 + k, 2.0, 0.0), (6.0 + k, 2.0)), known=5.0))
        stepped.step(ended=Reason.ROUTE_TIMEOUT)
    assert stepped.actions[0] == Go((1.0, 2.0, 0.0)), "farther back the next time"
    stepped.step(ended=Reason.GOAL_REACHED)
    assert stepped.run.phase is Phase.LOOKING


@pytest.mark.parametrize(
    ("seen", "outcome"),
    [
        ({"charge": 0.1}, Reason.CHARGE_SPENT),
        ({"charge": 0.8, "low": True}, Reason.BATTERY_LOW),
        ({"seconds": 1001.0}, Reason.BUDGET_SPENT),
    ],
)
def test_it_drives_home_in_time(seen: dict, outcome: Reason):
    stepped = SteppedExploration()
    stepped.step(charge=0.9)
    stepped.step(answer=ExploreAnswer(FIRST, known=5.0, home=30.0))
    stepped.pose = (41.0, 2.0, 0.0)  # by now 40 m for 0.8 of the charge: 30 m home would take 0.6
    stepped.step(**seen)
    assert (stepped.run.phase, stepped.said()) == (Phase.RETURNING, [outcome])
    stepped.step()
    stepped.step(ended=Reason.GOAL_REACHED)
    assert stepped.saved().outcome is outcome


def test_the_charge_of_a_metre_is_configured_until_it_is_measured():
    stepped = SteppedExploration()
    stepped.step(charge=0.9)
    run = replace(stepped.run, travelled=10.0)
    assert exploration.charge_per_metre(run, 0.88, CONFIG) == 1.0 / CONFIG.full_range
    assert exploration.charge_per_metre(run, 0.80, CONFIG) == pytest.approx(0.01)


def test_lost_it_stands_and_goes_on_once_it_is_found_or_gives_up():
    stepped = SteppedExploration()
    stepped.drive()
    stepped.pose = None
    stepped.step()
    assert (stepped.run.phase, stepped.said(), stepped.actions[0]) == (Phase.LOST, [Reason.POSE_LOST], Cancel())
    stepped.pose = (2.0, 2.0, 0.0)
    stepped.step(3.0)
    assert (stepped.run.phase, stepped.said()) == (Phase.LOOKING, [Reason.POSE_FOUND])
    stepped.pose = None
    stepped.step()
    stepped.step(CONFIG.lost + 1.0)
    assert stepped.run.phase is Phase.SAVING
    assert stepped.saved().outcome is Reason.POSE_LOST


def test_lost_it_drives_to_and_fro_until_it_is_found():
    stepped = SteppedExploration()
    stepped.drive()
    stepped.pose, here = None, (2.0, 1.0, math.pi / 2)
    stepped.step(believed=here)
    stepped.step(STANDS - 1.0, believed=here)
    assert stepped.actions == (), "whoever carried it is still there"
    stepped.step(1.5, believed=here)
    assert stepped.actions[0] == Go(pytest.approx((2.0, 1.6, math.pi / 2)))
    assert stepped.said() == [Reason.RECOVERING]
    stepped.step(believed=here)
    assert stepped.actions == (), "the goal is pursued"
    there = (2.0, 1.58, math.pi / 2)
    stepped.step(believed=there, ended=Reason.GOAL_REACHED)
    stepped.step(exploration.AGAIN, believed=there)
    assert stepped.actions == (Go(here),), "over ground that it came over"
    stepped.step(believed=here, ended=Reason.GOAL_REACHED)
    stepped.step(exploration.AGAIN, believed=here)
    assert stepped.actions == (Go(pytest.approx((1.75, 1.6, math.pi / 2 + 0.8))),)
    stepped.step(believed=here, ended=Reason.GOAL_UNREACHABLE)
    stepped.step(exploration.AGAIN, believed=here)
    assert stepped.actions == (Go(pytest.approx((2.25, 1.6, math.pi / 2 - 0.8))),), (
        "nothing is known of what is behind it"
    )
    stepped.pose = (5.0, 5.0, 0.0)
    stepped.step(believed=stepped.pose)
    assert (stepped.run.phase, stepped.actions[0], stepped.said()) == (Phase.LOOKING, Cancel(), [Reason.POSE_FOUND])


def test_a_battery_that_may_give_out_any_moment_has_the_map_saved_at_once():
    stepped = SteppedExploration()
    stepped.drive()
    stepped.step(low=True, critical=True)
    assert stepped.actions == (Cancel(), Save())
    assert stepped.saved().outcome is Reason.BATTERY_CRITICAL


@pytest.mark.parametrize("phase", [Phase.LOOKING, Phase.DRIVING, Phase.LOST, Phase.RETURNING])
def test_where_a_service_failed_it_ends_where_it_stands_and_saves_the_map(phase: Phase):
    stepped = SteppedExploration()
    if phase is not Phase.LOOKING:
        stepped.drive()
    if phase is Phase.LOST:
        stepped.pose = None
        stepped.step()
    elif phase is Phase.RETURNING:
        stepped.step(low=True)
    stepped.step(failed="goals: a bug")
    assert stepped.actions == (Cancel(), Save())
    run = stepped.saved()
    assert (run.outcome, run.text) == (Reason.SERVICE_FAILED, "goals: a bug; map saved in somewhere")


@pytest.mark.parametrize("reason", [Reason.DISARMED, Reason.BUSY])
def test_where_no_place_helps_it_ends_where_it_stands(reason: Reason):
    stepped = SteppedExploration()
    stepped.drive()
    stepped.step(ended=reason, ended_text="why")
    assert stepped.saved().outcome is reason


def test_others_goals_and_cancelled_ones_end_it_without_a_way_home():
    for seen in ({"displaced": "bob"}, {"ended": Reason.CANCELLED, "ended_text": "by bob"}):
        stepped = SteppedExploration()
        stepped.drive()
        stepped.step(**seen)
        assert stepped.actions == (Save(),)
        run = stepped.saved()
        assert run.outcome is Reason.CANCELLED
        assert "bob" in run.text


def test_a_planner_that_is_starting_says_nothing_of_the_place():
    stepped = SteppedExploration()
    stepped.drive()
    stepped.step(ended=Reason.PLANNER_STARTING)
    assert (stepped.run.phase, stepped.run.attempts.places) == (Phase.LOOKING, ())


def test_a_planner_that_does_not_start_leaves_no_place_alone_and_is_named():
    """All places were left alone one after the other, and what was known then was "explored"."""
    stepped = SteppedExploration()
    stepped.drive()
    stepped.step(ended=Reason.WORKER_DIED, ended_text="the planner does not start: why", refused=True)
    assert (stepped.run.phase, stepped.run.attempts.places) == (Phase.LOOKING, ())
    assert stepped.run.text == "the planner does not start: why"
    stepped = SteppedExploration()
    stepped.drive()
    stepped.step(ended=Reason.WORKER_TIMEOUT, ended_text="of this goal")
    assert stepped.run.attempts.places, "a goal that takes too long to plan may be one of its place"


def test_it_says_what_it_waits_for():
    stepped = SteppedExploration()
    stepped.drive()
    assert stepped.run.text == ""
    stepped.step(ended=Reason.PLANNER_STARTING)
    assert stepped.run.text == "the planner is starting"


def test_the_way_home_is_tried_again_and_given_up_in_the_end():
    stepped = SteppedExploration()
    stepped.run = replace(stepped.run, now=0.0)
    stepped.exhaust()
    assert stepped.run.phase is Phase.RETURNING
    sent = 0
    while stepped.run.phase is Phase.RETURNING and stepped.now < 300:
        stepped.step(1.0, ended=Reason.STUCK if stepped.run.target is not None else None)
        sent += Go(HOME) in stepped.actions
    assert sent == RETURNS
    assert stepped.now > 60.0, "somebody in a door goes on meanwhile"
    assert stepped.saved().outcome is Reason.STUCK
    assert "not back at the start" in stepped.run.text


def test_where_the_start_is_blocked_a_place_beside_it_is_home():
    """As for a robot that was started beside a wall, or never saw what was behind it there, however far it drove."""
    stepped = SteppedExploration()
    stepped.drive()
    for x in (1.1, 1.3, 1.6, 2.4, *np.arange(3.0, 12.0, 0.5)):
        stepped.pose = (float(x), 2.0, 0.5)
        stepped.step()
    stepped.step(ended=Reason.GOAL_REACHED, answer=NOTHING)
    while stepped.run.phase is not Phase.RETURNING:
        stepped.look(NOTHING)
    stepped.step()
    assert stepped.actions == (Go(HOME),)
    stepped.step(ended=Reason.GOAL_BLOCKED)
    stepped.step(exploration.AGAIN)
    assert stepped.actions == (Go((1.3, 2.0, 0.5)),)
    stepped.step(ended=Reason.GOAL_BLOCKED)
    stepped.step(2 * exploration.AGAIN)
    assert stepped.actions == (Go((1.6, 2.0, 0.5)),)
    stepped.step(ended=Reason.GOAL_REACHED)
    assert stepped.saved().outcome is Reason.EXPLORED
    assert "0.6 m from the start, which is not free in the map" in stepped.run.text


def test_a_robot_that_stands_beside_its_blocked_start_is_back():
    stepped = SteppedExploration()
    stepped.exhaust()
    stepped.pose = (1.9, 2.0, 0.5)
    stepped.step()
    stepped.step(ended=Reason.GOAL_BLOCKED)
    assert stepped.saved().outcome is Reason.EXPLORED
    assert "0.9 m from the start, which is not free in the map" in stepped.run.text


def test_without_a_map_or_a_place_to_save_it_says_so():
    stepped = SteppedExploration(home=False)
    while stepped.run.phase is Phase.LOOKING:
        stepped.look(ExploreAnswer())
        assert stepped.now < 100
    assert stepped.step(saved="").outcome is Reason.NO_MAP
    assert stepped.run.text.endswith("map not saved")
    full = SteppedExploration()
    full.run, _ = exploration.stop(full.run, "bob", full.now)
    assert full.step(saved="", save_failure="no space left").text == "stopped by bob; map not saved: no space left"


def test_where_the_worker_fails_again_and_again_it_says_that_and_not_that_there_is_no_map():
    stepped = SteppedExploration(home=False)
    stepped.look(ExploreAnswer(known=7.0, frontiers=2, home=3.0))
    while stepped.run.phase is Phase.LOOKING:
        stepped.look(ExploreAnswer(failure=Reason.NOT_INSTALLED, text="numba is missing"))
        assert stepped.now < 100
        assert stepped.run.newest.known == 7.0
    assert stepped.saved().outcome is Reason.NOT_INSTALLED
    assert "numba is missing" in stepped.run.text


def test_stopped_it_cancels_the_goal_and_saves():
    stepped = SteppedExploration()
    stepped.drive()
    stepped.run, actions = exploration.stop(stepped.run, "bob", stepped.now)
    assert actions == (Cancel(), Save())
    assert stepped.saved().outcome is Reason.CANCELLED


def test_places_are_left_alone_until_their_time_is_over():
    assert Attempts(60.0, 3).failed((1.0, 1.0), 10.0, ignore_first=True).banned(10.0) == ()
    attempts = Attempts(60.0, 2).failed((1.0, 1.0), 10.0)
    assert attempts.banned(69.0) == ((1.0, 1.0),)
    assert attempts.banned(70.0) == ()
    released = attempts.released(20.0)
    assert released is not None
    assert released.banned(20.0) == ()
    again = attempts.failed((1.2, 1.0), 80.0)
    assert again.banned(math.inf) == ()
    assert again.banned(1e9) == ((1.2, 1.0),)
    assert again.released(90.0) is None


def test_a_pose_that_trembles_is_no_way():
    stepped = SteppedExploration()
    stepped.drive()
    x, y, yaw = stepped.pose
    began = stepped.run.travelled
    for k in range(100):
        stepped.pose = (x + 0.002 * (-1) ** k, y, yaw)
        stepped.step()
    assert stepped.run.travelled == began
    for k in range(100):
        stepped.pose = (x + 0.005 * k, y, yaw)
        stepped.step()
    assert stepped.run.travelled - began == pytest.approx(0.495, abs=0.03)


def test_while_its_goal_is_paused_it_decides_nothing_and_sends_no_other():
    trip = SteppedExploration(budget=100.0)
    trip.drive()
    for _ in range(3):
        assert trip.step(60.0, paused=True, answer=ExploreAnswer(SECOND, known=5.0)).phase is Phase.DRIVING
        assert trip.actions == ()
    assert trip.step().phase is Phase.RETURNING, "resumed, it goes by its budget again"


@pytest.mark.parametrize("looking", [True, False])
def test_an_emergency_stop_ends_it_where_it_is(looking: bool):
    trip = SteppedExploration()
    if not looking:
        trip.drive()
    trip.step(estopped=True)
    assert trip.actions == (Cancel(), Save())
    assert trip.saved().outcome is Reason.ESTOPPED
