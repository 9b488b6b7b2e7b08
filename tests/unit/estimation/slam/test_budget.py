"""What one scan may spend on long searches."""

from monstertruck_estimation.slam.budget import PiecewiseSearch, ScanBudget, Work, finished
from monstertruck_estimation.slam.closure import LoopCloser
from monstertruck_estimation.slam.keyframes import KeyframeMap
from tests.unit.estimation.slam.test_closure import far_round


def pieces(costs, done):
    for cost in costs:
        yield cost
        done.append(cost)
    return len(done)


def test_pieces_are_done_while_the_budget_lasts_and_continued_at_the_next_scan():
    done = []
    progress = PiecewiseSearch(pieces([3.0, 3.0, 3.0, 9.0, 1.0], done))
    amounts = []
    while not progress.run(ScanBudget(7.0)):
        amounts.append(len(done))
    assert amounts == [2, 3, 4]
    assert progress.result == 5


def test_a_search_without_limit_gives_its_result():
    assert finished(pieces([1e12, 1e12], [])) == 2


class Counted(ScanBudget):
    """Remembers the pieces it allowed."""

    def __init__(self):
        super().__init__()
        self.pieces = []

    def allows(self, cost):
        allowed = super().allows(cost)
        if allowed:
            self.pieces.append(cost)
        return allowed


def test_loops_are_searched_for_within_the_budget_of_each_scan_and_repeatably():
    ends = []
    for _ in range(2):
        keyframes, _ = far_round()
        closer, spent = LoopCloser(), []
        for at in range(len(keyframes)):
            closer.watch(at)
            budget = Counted()
            closer.step(keyframes, budget)
            spent.append(budget.pieces)
        assert closer.searches
        assert all(sum(one) <= Work.SCAN or sum(piece > 0 for piece in one) == 1 for one in spent)
        ends.append((spent, keyframes.poses.tobytes()))
    assert ends[0] == ends[1]


def test_few_keyframes_wait_for_their_search():
    keyframes: KeyframeMap = far_round()[0]
    closer = LoopCloser()
    for at in range(len(keyframes)):
        closer.watch(at)
    for _ in range(200):
        closer.step(keyframes, ScanBudget())
    assert not closer.busy
    searched = sorted(closer._fingerprints)
    assert searched == list(range(len(keyframes) - 20, len(keyframes)))
