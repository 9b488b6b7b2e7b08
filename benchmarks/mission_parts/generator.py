"""Generated missions, and scripts of events while they run."""

import json
import random
from dataclasses import dataclass, field
from typing import Any, Literal

VISITS = 400
"""Begun steps that a script has events for."""


@dataclass
class Script:
    """Events at the n-th step that begins, counted from 1, including repeated steps."""

    fails: set[int] = field(default_factory=set)
    """Goals that fail, if it is one."""
    changes: dict[int, tuple[str, Any]] = field(default_factory=dict)
    """After ``CHANGE_AFTER`` s: ``charge`` (%) or the known ``points``."""
    restarts: dict[int, Literal["ordered", "killed"]] = field(default_factory=dict)
    """After ``BREAK_AFTER`` s."""
    estop: int | None = None
    """After ``BREAK_AFTER`` s."""


CHANGE_AFTER = 0.5
BREAK_AFTER = 1.0
SECONDS = 2.0
"""Duration of a goal or a wait."""


def script(rng: random.Random) -> Script:
    """Return a random script."""
    made = Script()
    for visit in range(1, VISITS):
        if rng.random() < 0.25:
            made.fails.add(visit)
        if rng.random() < 0.4:
            charge = ("charge", rng.choice((10.0, 50.0, 90.0)))
            made.changes[visit] = charge if rng.random() < 0.6 else ("points", rng.choice(((), ("a",), ("a", "b"))))
        if rng.random() < 0.15:
            made.restarts[visit] = rng.choice(("ordered", "killed"))
    if rng.random() < 0.3:
        made.estop = rng.randint(1, 25)
    return made


class _Maker:
    def __init__(self, rng: random.Random) -> None:
        self.rng, self.count = rng, 0

    def steps(self, depth: int, most: int) -> list[dict[str, Any]]:
        return [self.step(depth) for _ in range(self.rng.randint(1, most))]

    def step(self, depth: int) -> dict[str, Any]:
        rng = self.rng
        made = self.leaf() if depth == 0 or rng.random() < 0.35 else self.container(depth)
        if rng.random() < 0.2:
            made["retries"] = rng.randint(1, 2)
        if rng.random() < 0.2:
            made["on_failure"] = rng.choice(("continue", "continue", "return", "abort"))
        return made

    def leaf(self) -> dict[str, Any]:
        self.count += 1
        kind = self.rng.choice(("goto", "goto", "goto", "wait", "record", "condition", "wait_until"))
        match kind:
            case "goto":
                limit = {"limit": 1.7} if self.rng.random() < 0.15 else {}
                return {"do": "goto", "x": float(self.count), "y": 0.0, "yaw": 0.0, **limit}
            case "wait":
                return {"do": "wait", "seconds": SECONDS}
            case "record":
                return {"do": "record", "note": f"n{self.count}"}
            case "condition":
                return {"do": "condition", "when": self.battery()}
            case _:
                return {"do": "wait_until", "when": {"point": self.rng.choice("ab")}, "limit": 1.7}

    def battery(self) -> dict[str, Any]:
        low, high = {"battery_below": 20.0}, {"battery_above": 80.0}
        return self.rng.choice(
            (low, high, {"unless": low}, {"any_of": [low, high]}, {"unless": {"any_of": [low, high]}})
        )

    def container(self, depth: int) -> dict[str, Any]:
        rng, kind = self.rng, self.rng.choice(("sequence", "fallback", "repeat", "branch", "parallel", "parallel"))
        made: dict[str, Any] = {"do": kind}
        if rng.random() < 0.2:
            made["limit"] = 3.3
        if kind == "branch":
            made |= {"when": self.battery(), "then": self.steps(depth - 1, 2)}
            if rng.random() < 0.6:
                made["otherwise"] = self.steps(depth - 1, 2)
            return made
        made["steps"] = self.steps(depth - 1, 3)
        if kind == "repeat":
            made["times"] = rng.randint(1, 3)
            if rng.random() < 0.4:
                made["until"] = self.battery()
        if kind == "parallel":
            made["watch"] = [
                {"when": when, "then": self.steps(depth - 1, 2), "after": rng.choice(("resume", "resume", "end"))}
                for when in rng.sample(({"battery_below": 20.0}, {"battery_above": 80.0}), rng.randint(1, 2))
            ]
        return made


def mission(rng: random.Random) -> str:
    """Return a random mission as JSON, which is valid YAML."""
    maker = _Maker(rng)
    policy = rng.choice(("abort", "continue", "return"))
    return json.dumps({"version": 2, "name": "generated", "on_failure": policy, "steps": maker.steps(3, 4)})
