"""All sonars of a robot at once, without a world: for tests and for studies of wall following."""

from collections.abc import Mapping, Sequence

import numpy as np

from monstertruck_sim.world.config import SonarModelConfig
from monstertruck_sim.world.plant import Caster
from monstertruck_sim.world.sonar import beam, cone, heard, placed, surface


def survey(
    cast: Caster,
    pose: tuple[float, float, float],
    model: SonarModelConfig,
    noise: np.random.Generator | None,
    groups: Sequence[Sequence[str]] = (("l", "f", "r"), ("fl", "fr")),
    gap: float = 0.05,
) -> Mapping[str, float]:
    """All sonars of a robot at ``pose`` once: groups fire one after the other, their members together.

    Args:
        cast: the walls.
        pose: x, y (m) and yaw (rad) of the geometric centre in the map frame; the same for all groups.
        model: settings, the sonars' places among them.
        noise: see ``heard``.
        groups: names of ``model.sonars``.
        gap: between groups, and between the last one and the first of the next survey, s.

    Returns:
        Range by name, m; inf = no echo.
    """
    if model.model == "beam":
        ranges = {name: beam(cast, placed(model.sonars[name], *pose), model) for group in groups for name in group}
        return {name: heard(distance, model, noise) for name, distance in ranges.items()}
    pings = [{n: placed(model.sonars[n], *pose, i * gap) for n in group} for i, group in enumerate(groups)]
    found = {name: surface(cast, ping, model) for group in pings for name, ping in group.items()}
    ranges = {}
    for i, group in enumerate(pings):
        before = pings[i - 1] if len(pings) > 1 else {}
        late = {n: found[n]._replace(ping=p._replace(time=(i - 1) * gap)) for n, p in before.items()}
        for name, ping in group.items():
            ranges[name] = cone([*(found[n] for n in group), *late.values()], ping, model)
    return {name: heard(distance, model, noise) for name, distance in ranges.items()}
