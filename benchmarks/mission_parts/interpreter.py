"""Independent interpreter of missions: recursive, on plain data, without the service's code.

A node returns None if it succeeded, or the reason of its failure. A leaf advances the time by its duration and handles
the events of the script. An external interruption of a leaf is an exception caught by the node concerned; an
interruption that resumes runs within the interrupted leaf.
"""

from dataclasses import dataclass, field
from typing import Any

from ruamel.yaml import YAML

from benchmarks.mission_parts.generator import BREAK_AFTER, CHANGE_AFTER, SECONDS, Script


@dataclass
class Outcome:
    """End of a mission, and its started steps."""

    reason: str
    steps: list[str]
    restarts: int = 0
    interruptions: int = 0


class AmbiguousError(Exception):
    """A limit ends so close to another event that the order depends on the service's check rate."""


class OverError(Exception):
    """The mission has ended."""


class HomeError(Exception):
    """The robot drives back for a reason."""


@dataclass(eq=False)
class Scope:
    """A node that contains the current leaf."""

    node: dict[str, Any]
    spent: float = 0.0
    handling: bool = False
    fired: set[int] = field(default_factory=set)


class LeftError(Exception):
    """A scope has ended from inside a leaf, with a reason or None."""

    def __init__(self, scope: Scope, reason: str | None) -> None:
        super().__init__(reason)
        self.scope, self.reason = scope, reason


class _Interpreter:
    def __init__(self, script: Script) -> None:
        self.script, self.visit, self.failures = script, 0, 0
        self.charge, self.points, self.trace, self.restarts = 50.0, (), [], 0
        self.scopes: list[Scope] = []

    def holds(self, when: dict[str, Any]) -> bool:
        tests = {
            "battery_below": lambda value: self.charge < value,
            "battery_above": lambda value: self.charge > value,
            "point": lambda value: value in self.points,
            "any_of": lambda some: any(map(self.holds, some)),
            "unless": lambda other: not self.holds(other),
        }
        return all(tests[key](value) for key, value in when.items())

    # Composites

    def node(self, node: dict[str, Any], inherited: str) -> str | None:
        for _ in range(node.get("retries", 0) + 1):
            scope = Scope(node)
            outer = list(self.scopes)
            try:
                reason = self.attempt(node, scope)
            except LeftError as left:
                if left.scope is not scope:
                    raise
                reason = left.reason
            finally:
                self.scopes = outer
            if reason is None:
                return None
        match node.get("on_failure", inherited):
            case "continue":
                self.failures += 1
                return None
            case "return":
                raise HomeError(reason)
        return reason

    def attempt(self, node: dict[str, Any], scope: Scope) -> str | None:
        if node["do"] in ("goto", "wait", "record", "condition", "wait_until"):
            return self.leaf(node)
        if node["do"] == "branch":
            steps = node["then"] if self.holds(node["when"]) else node.get("otherwise", [])
            if not steps:
                return self.leaf(node)
            self.scopes = [*self.scopes, scope]
            return self.sequence(steps)
        self.scopes = [*self.scopes, scope]
        if node["do"] == "fallback":
            reason = None
            for step in node["steps"]:
                if (reason := self.node(step, "abort")) is None:
                    return None
            return reason
        if node["do"] == "repeat":
            for _ in range(node["times"]):
                if (reason := self.sequence(node["steps"])) is not None:
                    return reason
                if "until" in node and self.holds(node["until"]):
                    return None
            return "mission_incomplete" if "until" in node else None
        return self.sequence(node["steps"])

    def sequence(self, steps: list[dict[str, Any]]) -> str | None:
        for step in steps:
            if (reason := self.node(step, "abort")) is not None:
                return reason
        return None

    # Leaves

    def leaf(self, node: dict[str, Any]) -> str | None:
        while True:
            self.watches()
            self.visit += 1
            self.trace.append(label(node))
            changed, result = self.run(node)
            if not changed:
                return result

    def watches(self) -> None:
        """Run what a watch has started, repeatedly until nothing interrupts."""
        while (interrupted := self.interrupting()) is not None:
            scope, index = interrupted
            inside, watch = self.scopes, scope.node["watch"][index]
            self.scopes = inside[: inside.index(scope) + 1]
            scope.fired.add(index)
            scope.handling = True
            reason = self.sequence(watch["then"])
            if reason is not None or watch["after"] == "end":
                raise LeftError(scope, reason)
            scope.handling, self.scopes = False, inside

    def interrupting(self) -> tuple[Scope, int] | None:
        for scope in self.scopes:
            watches = scope.node.get("watch", [])
            scope.fired &= {index for index, watch in enumerate(watches) if self.holds(watch["when"])}
            for index, watch in enumerate(watches):
                if not scope.handling and index not in scope.fired and self.holds(watch["when"]):
                    return scope, index
        return None

    def run(self, node: dict[str, Any]) -> tuple[bool, str | None]:
        """Run a leaf once; return whether it must start again, and its result."""
        kind = node["do"]
        if (expired := self.expired(0.0)) is not None:
            raise LeftError(expired, "timeout")
        if kind in ("record", "branch"):
            return False, None
        if kind in ("condition", "wait_until"):
            holds = self.holds(node["when"])
            if kind == "condition" or holds:
                return False, None if holds else "mission_incomplete"
        ends = SECONDS if kind in ("goto", "wait", "return") else 1e9
        left = {scope: scope.node["limit"] - scope.spent for scope in self.scopes if "limit" in scope.node}
        stop = min([ends, node.get("limit", 1e9), *left.values()])
        moments = (ends, node.get("limit", 1e9), CHANGE_AFTER, BREAK_AFTER)
        # 0.35: longest time by which checks and reports can delay the end of a few steps, s
        if any(abs(rest - moment) < 0.35 for rest in left.values() for moment in moments):
            raise AmbiguousError
        if (met := self.met(node, stop)) is not None:
            return met, None
        self.spend(stop)
        if (expired := self.expired(1e-6)) is not None:
            raise LeftError(expired, "timeout")
        if stop < ends:
            return False, "timeout"
        return False, "goal_unreachable" if kind in ("goto", "return") and self.visit in self.script.fails else None

    def met(self, node: dict[str, Any], stop: float) -> bool | None:
        """Handle events before a leaf stops: None if it continues, otherwise whether it must start again."""
        if stop > CHANGE_AFTER and self.visit in self.script.changes:
            key, value = self.script.changes[self.visit]
            setattr(self, key, value)
            interrupted = self.interrupting() is not None
            if interrupted or (node["do"] == "wait_until" and self.holds(node["when"])):
                self.spend(CHANGE_AFTER)
                return interrupted
        if stop <= BREAK_AFTER:
            return None
        if self.script.estop == self.visit:
            raise OverError("estopped")
        if self.visit not in self.script.restarts:
            return None
        self.restarts += 1
        self.spend(BREAK_AFTER if self.script.restarts[self.visit] == "ordered" else 0.0)
        return True

    def spend(self, seconds: float) -> None:
        for scope in self.scopes:
            scope.spent += seconds

    def expired(self, slack: float) -> Scope | None:
        return next((s for s in self.scopes if s.spent + slack >= s.node.get("limit", 1e9)), None)

    def mission(self, mission: dict[str, Any]) -> str:
        try:
            for step in mission["steps"]:
                if (reason := self.node(step, mission["on_failure"])) is not None:
                    return reason
        except OverError as over:
            return str(over)
        except HomeError as home:
            self.scopes = []
            try:
                back = self.leaf({"do": "return"})
            except OverError as over:
                return str(over)
            return str(home) if back is None else back
        return "mission_incomplete" if self.failures else "mission_done"


def label(node: dict[str, Any]) -> str:
    """Return the name of a leaf in the trace."""
    which = {"goto": "x", "record": "note"}.get(node["do"])
    return node["do"] if which is None else f"{node['do']} {node[which]:g}" if which == "x" else f"record {node[which]}"


def expected(text: str, script: Script) -> Outcome:
    """Return the required outcome of a mission.

    Raises:
        AmbiguousError: it depends on fractions of a second.
    """
    interpreter = _Interpreter(script)
    reason = interpreter.mission(YAML(typ="safe", pure=True).load(text))
    return Outcome(reason, interpreter.trace, interpreter.restarts)
