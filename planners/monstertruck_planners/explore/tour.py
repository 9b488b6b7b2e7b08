"""The explorer that goes where a short tour over all frontiers begins."""

import math

import numpy as np

from monstertruck_planners.explore.api import ExplorationView, Option
from monstertruck_planners.explore.config import TourConfig
from monstertruck_planners.explore.exchange import Viewpoint
from monstertruck_planners.explore.kernels import short_tour

FAR = 1e4
"""Stands for a way that is not known, m."""


class Tour:
    """The first place of a short tour.

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
        options = sorted(view.options, key=lambda option: option.way)[: self._config.most]
        if not options:
            return None
        first = np.array([self._first(option, option is still) for option in options])
        distance = np.minimum(view.ways_between(options), FAR) if len(options) > 2 else np.zeros((len(options),) * 2)
        if len(options) == 2:
            distance[0, 1] = distance[1, 0] = 1.0
        chosen = options[int(short_tour(distance, first)[0])]
        return pursued if chosen is still else chosen.target

    def _first(self, option: Option, present: bool) -> float:
        begin = option.way + self._config.turning * option.turn / math.pi
        return max(begin - self._config.keep, 0.0) if present else begin
