"""One exploration: the state machine, and the places that are left alone."""

import math
from dataclasses import replace

import pytest

from monstertruck_planners.explore import exploration
from monstertruck_planners.explore.attempts import Attempts
from monstertruck_planners.explore.config import TourConfig
from monstertruck_planners.explore.exchange import ExploreAnswer, Viewpoint
from monstertruck_planners.explore.exploration import Cancel, Choose, Exploration, Go, Notice, Observed, Save
from monstertruck_schemas.plan import ExplorationPhase as Phase
from monstertruck_schemas.reasons import Reason

HOME = (1.0, 2.0, 0.5)
CONFIG = TourConfig()
FIRST, SECOND = Viewpoint((3.0, 2.0, 0.0), (4.0, 2.0), 2.0, 1.0), Viewpoint((0.0, 5.0, 1.0), (0.0, 6.0), 3.0, 2.0)
NOTHING = ExploreAnswer(known=10.0, home=1.0)


class Tale:
    """An exploration with given observations."""

    def __init__(self, **more) -> None:
        more = {"home": True, "budget": 1000.0} | more
        self.run, self.actions = exploration.begin(1, "ann", HOME, 0.0, CONFIG, **more)
        self.now, self.pose = 0.0, HOME

    def tell(self, seconds: float = 0.2, **seen) -> Exploration:
        self.now += seconds
        observed = Observed(**{"now": self.now, "pose": self.pose} | seen)
        self.run, self.actions = exploration.tick(self.run, observed, CONFIG)
        return self.run

    def said(self) -> list[Reason]:
        return [action.reason for action in self.actions if isinstance(action, Notice)]

    def drive(self, target: Viewpoint = FIRST) -> None:
        self.tell()
        assert self.actions == (Choose(),)
        self.tell(answer=ExploreAnswer(target, frontiers=2, known=5.0, home=3.0))
        assert self.actions[0] == Go(target.pose)
        assert self.run.phase is Phase.DRIVING

    def look(self, answer: ExploreAnswer) -> None:
        """Wait until it asks, and answer."""
        while Choose() not in self.actions:
            self.tell()
            assert self.now < 500
        self.tell(answer=answer)

    def exhaust(self) -> None:
        for _ in range(exploration.CONFIRM):
            self.look(NOTHING)

    def saved(self) -> Exploration:
        assert self.run.phase is Phase.SAVING
        return self.tell(saved="somewhere")


def test_it_looks_drives_looks_again_and_ends_at_home_with_a_saved_map():
    tale = Tale()
    tale.drive()
    tale.pose = FIRST.pose
    tale.tell(ended=Reason.GOAL_REACHED)
    assert tale.run.phase is Phase.LOOKING
    assert tale.run.attempts.banned(tale.now) == (FIRST.frontier,)
    tale.exhaust()
    tale.exhaust()  # the place it came from is looked at once more
    assert (tale.run.phase, tale.said()) == (Phase.RETURNING, [Reason.EXPLORED])
    tale.tell()
    assert tale.actions == (Go(HOME),)
    tale.tell(ended=Reason.GOAL_REACHED)
    assert tale.actions == (Save(),)
    assert tale.saved().outcome is Reason.EXPLORED
    assert "back at the start" in tale.run.text
    assert "somewhere" in tale.run.text
    assert tale.run.travelled == pytest.approx(2.0)


def test_while_it_drives_it_goes_on_or_turns_to_another_place():
    tale = Tale()
    tale.drive()
    tale.tell(1.0)
    assert tale.actions == (Choose(),)
    tale.tell(0.1, answer=ExploreAnswer(FIRST, kept=True, known=6.0))
    assert tale.actions == ()
    assert tale.run.newest.home == 3.0  # the last one that was known
    tale.tell(1.0)
    tale.tell(answer=ExploreAnswer(SECOND, known=6.0))
    assert tale.actions[0] == Go(SECOND.pose)
    tale.tell(1.0)
    tale.tell(answer=ExploreAnswer(known=7.0))
    assert tale.actions == (Cancel(),)
    assert tale.run.phase is Phase.LOOKING


def test_a_place_it_cannot_come_to_is_left_alone_for_a_while_and_then_for_good():
    tale = Tale()
    for attempt in range(CONFIG.attempts):
        tale.look(ExploreAnswer(FIRST, known=5.0))
        tale.tell(ended=Reason.GOAL_UNREACHABLE)
        assert tale.said() == [Reason.GOAL_UNREACHABLE]
        assert tale.run.failures == attempt + 1
        assert tale.run.unreached.banned(tale.now) == (FIRST.pose[:2],)
        # After the first time the frontier may still be looked at from another place.
        assert tale.run.attempts.banned(tale.now) == ((FIRST.frontier,) if attempt else ())
        if attempt + 1 < CONFIG.attempts:
            tale.exhaust()
            assert tale.said() == [Reason.RECOVERING]
            assert tale.run.attempts.banned(tale.now) == ()
    tale.exhaust()
    assert tale.said() == [Reason.EXPLORED]


def test_where_no_place_can_be_reached_it_drives_back_and_blames_none_of_them():
    tale = Tale()
    for x in (1.0, 1.6, 2.2):
        tale.pose = (x, 2.0, 0.0)
        tale.tell()
    tale.run = replace(tale.run, waiting=False, asked=-math.inf)
    for k in range(exploration.STUCK):
        tale.look(ExploreAnswer(Viewpoint((5.0 + k, 2.0, 0.0), (6.0 + k, 2.0)), known=5.0))
        tale.tell(ended=Reason.ROUTE_TIMEOUT)
    assert tale.said() == [Reason.RECOVERING]
    assert tale.actions[0] == Go((1.6, 2.0, 0.0))
    assert (tale.run.attempts.places, tale.run.unreached.places) == ((), ())
    tale.tell(2.0)
    assert Choose() not in tale.actions, "it drives back first"
    tale.tell(ended=Reason.ROUTE_TIMEOUT)
    assert tale.run.phase is Phase.LOOKING
    for k in range(exploration.STUCK):
        tale.look(ExploreAnswer(Viewpoint((5.0 + k, 2.0, 0.0), (6.0 + k, 2.0)), known=5.0))
        tale.tell(ended=Reason.ROUTE_TIMEOUT)
    assert tale.actions[0] == Go((1.0, 2.0, 0.0)), "farther back the next time"
    tale.tell(ended=Reason.GOAL_REACHED)
    assert tale.run.phase is Phase.LOOKING


@pytest.mark.parametrize(
    ("seen", "outcome"),
    [
        ({"charge": 0.1}, Reason.CHARGE_SPENT),
        ({"charge": 0.8, "low": True}, Reason.BATTERY_LOW),
        ({"seconds": 1001.0}, Reason.BUDGET_SPENT),
    ],
)
def test_it_drives_home_in_time(seen: dict, outcome: Reason):
    tale = Tale()
    tale.tell(charge=0.9)
    tale.tell(answer=ExploreAnswer(FIRST, known=5.0, home=30.0))
    tale.pose = (41.0, 2.0, 0.0)  # by now 40 m for 0.8 of the charge: 30 m home would take 0.6
    tale.tell(**seen)
    assert (tale.run.phase, tale.said()) == (Phase.RETURNING, [outcome])
    tale.tell()
    tale.tell(ended=Reason.GOAL_REACHED)
    assert tale.saved().outcome is outcome


def test_the_charge_of_a_metre_is_configured_until_it_is_measured():
    tale = Tale()
    tale.tell(charge=0.9)
    run = replace(tale.run, travelled=10.0)
    assert exploration.charge_per_metre(run, 0.88, CONFIG) == 1.0 / CONFIG.full_range
    assert exploration.charge_per_metre(run, 0.80, CONFIG) == pytest.approx(0.01)


def test_lost_it_stands_and_goes_on_once_it_is_found_or_gives_up():
    tale = Tale()
    tale.drive()
    tale.pose = None
    tale.tell()
    assert (tale.run.phase, tale.said(), tale.actions[0]) == (Phase.LOST, [Reason.POSE_LOST], Cancel())
    tale.pose = (2.0, 2.0, 0.0)
    tale.tell(3.0)
    assert (tale.run.phase, tale.said()) == (Phase.LOOKING, [Reason.POSE_FOUND])
    tale.pose = None
    tale.tell()
    tale.tell(CONFIG.lost + 1.0)
    assert tale.run.phase is Phase.SAVING
    assert tale.saved().outcome is Reason.POSE_LOST


def test_lost_it_drives_to_and_fro_until_it_is_found():
    tale = Tale()
    tale.drive()
    tale.pose, here = None, (2.0, 1.0, math.pi / 2)
    tale.tell(believed=here)
    tale.tell(exploration.STANDS - 1.0, believed=here)
    assert tale.actions == (), "whoever carried it is still there"
    tale.tell(1.5, believed=here)
    assert tale.actions[0] == Go(pytest.approx((2.0, 1.6, math.pi / 2)))
    assert tale.said() == [Reason.RECOVERING]
    tale.tell(believed=here)
    assert tale.actions == (), "the goal is pursued"
    tale.tell(believed=here, ended=Reason.GOAL_UNREACHABLE)
    tale.tell(exploration.AGAIN, believed=here)
    assert tale.actions == (Go(pytest.approx((2.0, 0.1, math.pi / 2))),)
    tale.pose = (5.0, 5.0, 0.0)
    tale.tell(believed=tale.pose)
    assert (tale.run.phase, tale.actions[0], tale.said()) == (Phase.LOOKING, Cancel(), [Reason.POSE_FOUND])


def test_a_battery_that_may_give_out_any_moment_has_the_map_saved_at_once():
    tale = Tale()
    tale.drive()
    tale.tell(low=True, critical=True)
    assert tale.actions == (Cancel(), Save())
    assert tale.saved().outcome is Reason.BATTERY_CRITICAL


@pytest.mark.parametrize("reason", [Reason.DISARMED, Reason.BUSY])
def test_where_no_place_helps_it_ends_where_it_stands(reason: Reason):
    tale = Tale()
    tale.drive()
    tale.tell(ended=reason, ended_text="why")
    assert tale.saved().outcome is reason


def test_others_goals_and_cancelled_ones_end_it_without_a_way_home():
    for seen in ({"displaced": "bob"}, {"ended": Reason.CANCELLED, "ended_text": "by bob"}):
        tale = Tale()
        tale.drive()
        tale.tell(**seen)
        assert tale.actions == (Save(),)
        run = tale.saved()
        assert run.outcome is Reason.CANCELLED
        assert "bob" in run.text


def test_a_planner_that_is_starting_says_nothing_of_the_place():
    tale = Tale()
    tale.drive()
    tale.tell(ended=Reason.PLANNER_STARTING)
    assert (tale.run.phase, tale.run.attempts.places) == (Phase.LOOKING, ())


def test_the_way_home_is_tried_again_and_given_up_in_the_end():
    tale = Tale()
    tale.run = replace(tale.run, now=0.0)
    tale.exhaust()
    assert tale.run.phase is Phase.RETURNING
    sent = 0
    while tale.run.phase is Phase.RETURNING and tale.now < 300:
        tale.tell(1.0, ended=Reason.STUCK if tale.run.target is not None else None)
        sent += Go(HOME) in tale.actions
    assert sent == exploration.RETURNS
    assert tale.now > 60.0, "somebody in a door goes on meanwhile"
    assert tale.saved().outcome is Reason.STUCK
    assert "not back at the start" in tale.run.text


def test_without_a_map_or_a_place_to_save_it_says_so():
    tale = Tale(home=False)
    while tale.run.phase is Phase.LOOKING:
        tale.look(ExploreAnswer())
        assert tale.now < 100
    assert tale.tell(saved="").outcome is Reason.NO_MAP
    assert "map not saved" in tale.run.text


def test_stopped_it_cancels_the_goal_and_saves():
    tale = Tale()
    tale.drive()
    tale.run, actions = exploration.stop(tale.run, "bob", tale.now)
    assert actions == (Cancel(), Save())
    assert tale.saved().outcome is Reason.CANCELLED


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
