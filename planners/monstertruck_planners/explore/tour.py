"""Explorer that weighs the path to a frontier against its new area and a short tour over the other frontiers."""

import math

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.explore.api import ExplorationView, Option
from monstertruck_planners.explore.config import TourConfig
from monstertruck_planners.explore.exchange import Viewpoint
from monstertruck_planners.explore.kernels import short_tour, tour_length


class Tour:
    """Chooses the first place of the best tour.

    The cost of a tour is the path length to its first frontier, minus ``worth`` times the square root of the new area
    seen there (about its size in metres), plus ``rest`` times the length of a short tour over the other frontiers. A
    tour optimised only for length starts at any nearby shadow of a corner and reaches the large areas late. Most such
    shadows vanish by themselves or are too small to matter.

    Args:
        config: settings.
    """

    def __init__(self, config: TourConfig) -> None:
        self._config = config

    def choose(
        self, view: ExplorationView, pursued: Viewpoint | None, still: Option | None, seconds: float
    ) -> Viewpoint | None:
        """See ``Explorer``."""
        del seconds
        options = sorted(view.options, key=lambda option: self._first(option, option is still))[: self._config.most]
        if not options:
            return None
        chosen = options[0]
        if self._config.rest > 0.0 and len(options) > 2:
            first = np.array([self._first(option, option is still) for option in options])
            distance = np.minimum(view.path_lengths_between(options), 1e4)  # substitute for an unknown path (m)
            chosen = options[best_beginning(first, distance, self._config.rest)]
        return pursued if chosen is still else chosen.target

    def _first(self, option: Option, present: bool) -> float:
        config = self._config
        cost = option.path_length + config.turning * option.turn / math.pi - config.worth * math.sqrt(option.gain)
        return cost - config.keep if present else cost


def best_beginning(first: Array, distance: Array, rest: float) -> int:
    """Return the index of the first place of the best tour.

    Args:
        first: cost of each of the n > 2 places as the first one, ascending, shape (n,).
        distance: distances between the places, shape (n, n).
        rest: weight of the tour over the other places.
    """
    costs = []
    for k in range(min(len(first), 6)):  # number of frontiers compared as the first
        others = np.delete(np.arange(len(first)), k)
        between, begin = distance[np.ix_(others, others)], distance[k, others]
        costs.append(first[k] + rest * tour_length(between, begin, short_tour(between, begin)))
    return int(np.argmin(costs))
