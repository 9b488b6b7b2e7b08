"""The explorer that weighs the path to a frontier against its new area, and the short tour over the others after it."""

import math

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.explore.api import ExplorationView, Option
from monstertruck_planners.explore.config import TourConfig
from monstertruck_planners.explore.exchange import Viewpoint
from monstertruck_planners.explore.kernels import short_tour, tour_length


class Tour:
    """The first place of the best tour.

    Of a tour that begins with a frontier the cost is the way there, less ``worth`` times the square root of the new
    area that is seen from there (about its size in metres), plus ``rest`` times the length of the short tour over the
    others after it. A tour that only is short begins with whatever shadow of a corner is near, and comes late to the
    large areas: most of those shadows vanish by themselves, or are too small to matter.

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
            distance = np.minimum(view.path_lengths_between(options), 1e4)  # stands for a path that is not known, m
            chosen = options[best_beginning(first, distance, self._config.rest)]
        return pursued if chosen is still else chosen.target

    def _first(self, option: Option, present: bool) -> float:
        config = self._config
        cost = option.path_length + config.turning * option.turn / math.pi - config.worth * math.sqrt(option.gain)
        return cost - config.keep if present else cost


def best_beginning(first: Array, distance: Array, rest: float) -> int:
    """The place with which the best tour begins.

    Args:
        first: cost of each of the n > 2 places as the first one, ascending, shape (n,).
        distance: between them, shape (n, n).
        rest: weight of the tour over the others.
    """
    costs = []
    for k in range(min(len(first), 6)):  # frontiers that are compared as the first one
        others = np.delete(np.arange(len(first)), k)
        between, begin = distance[np.ix_(others, others)], distance[k, others]
        costs.append(first[k] + rest * tour_length(between, begin, short_tour(between, begin)))
    return int(np.argmin(costs))
