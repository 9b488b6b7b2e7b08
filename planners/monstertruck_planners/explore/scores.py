"""Explorers that score each frontier separately."""

import math

from monstertruck_planners.explore.api import ExplorationView, Option
from monstertruck_planners.explore.config import AuthorConfig, InformationConfig, NearestConfig
from monstertruck_planners.explore.exchange import Viewpoint


class Nearest:
    """Chooses the nearest frontier, and keeps it until it is gone.

    Args:
        config: settings.
    """

    def __init__(self, config: NearestConfig) -> None:
        del config

    def choose(
        self, view: ExplorationView, pursued: Viewpoint | None, still: Option | None, seconds: float
    ) -> Viewpoint | None:
        """See ``Explorer``."""
        del seconds
        if still is not None:
            return pursued
        return min(view.options, key=lambda option: option.path_length).target if view.options else None


class Information:
    """Chooses the frontier with the most new area per second of driving.

    The current goal is kept unless another is much better: its new area shrinks as it comes into sight, and a robot
    that always turns to the best frontier leaves small unexplored remnants everywhere.

    Args:
        config: settings.
    """

    def __init__(self, config: InformationConfig) -> None:
        self._config = config

    def choose(
        self, view: ExplorationView, pursued: Viewpoint | None, still: Option | None, seconds: float
    ) -> Viewpoint | None:
        """See ``Explorer``."""
        del seconds
        if not view.options:
            return None
        best = max(view.options, key=self._rate)
        if still is not None and self._rate(best) < self._config.better * self._rate(still):
            return pursued
        return best.target

    def _rate(self, option: Option) -> float:
        config = self._config
        return option.gain / (1.0 + option.path_length / config.speed + config.turning * option.turn / math.pi)


class Author:
    """Scores of the thesis author; a goal is kept until it is reached or the time ``patience`` has passed.

    Source: see ``AuthorConfig``.

    Args:
        config: weights.
    """

    def __init__(self, config: AuthorConfig) -> None:
        self._config = config
        self._chosen: list[tuple[float, float]] = []

    def choose(
        self, view: ExplorationView, pursued: Viewpoint | None, still: Option | None, seconds: float
    ) -> Viewpoint | None:
        """See ``Explorer``."""
        del still
        if pursued is not None and seconds < self._config.patience:
            return pursued
        if not view.options:
            return None
        longest = max(option.path_length for option in view.options)
        largest = max(option.frontier.length for option in view.options)
        best = max(view.options, key=lambda option: self._score(option, longest, largest))
        self._chosen.append(best.frontier.middle)
        return best.target

    def _score(self, option: Option, longest: float, largest: float) -> float:
        config = self._config
        times = sum(math.dist(option.frontier.middle, place) < config.near for place in self._chosen)
        return (
            config.size_weight * (1.0 - math.exp(-math.e * option.frontier.length / largest))
            + config.distance_weight * math.exp(-math.e * option.path_length / max(longest, 1e-9))
            + config.angle_weight * math.cos(option.turn / 2)
            + config.visits_weight * math.exp(-times)
        )
