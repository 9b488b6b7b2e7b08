"""The second set of operators makes the mistakes that it promises, and sources that still compile."""

import ast
from textwrap import dedent

import pytest

from benchmarks.mutation_parts.second import SECOND, second_mutants


def changes(source: str, operator: str) -> set[tuple[str, str]]:
    data = dedent(source).encode()
    found = second_mutants("x.py", data)
    for mutant in found:
        ast.parse(mutant.applied(data))
    return {(mutant.before, mutant.after) for mutant in found if mutant.operator == operator}


@pytest.mark.parametrize(
    ("operator", "source", "expected"),
    [
        ("unassigned", "def f(a):\n    a = g(a)\n    b = a", {("a = g(a)", "pass")}),
        ("unassigned", "class A:\n    def __init__(self):\n        self.a = 1", {("self.a = 1", "self.a = None")}),
        ("unawaited", "async def f():\n    await g(1)", {("await g(1)", "(g(1))")}),
        ("exchanged", "f(a, b)", {("f(a, b)", "(f(b, a))")}),
        ("exchanged", "f(x=c, y=d)", {("f(x=c, y=d)", "(f(x=d, y=c))")}),
        ("exchanged", "max(a, b)", set()),
        ("shifted", "a < b", {("a < b", "((a) < (b) * 1.1)"), ("a < b", "((a) < (b) / 1.1)")}),
        ("shifted", "len(a) < b", {("len(a) < b", "((len(a)) < (b) + 1)"), ("len(a) < b", "((len(a)) < (b) - 1)")}),
        ("shifted", "a[0]", {("0", "(-1)")}),
        ("shifted", "a[1:]", {("a[1:]", "(a[(1) + 1:])")}),
        ("unreturned", "def f():\n    return a", {("return a", "return None")}),
        ("uncaught", "try:\n    f()\nexcept KeyError:\n    pass", {("KeyError", "(())")}),
    ],
)  # fmt: skip
def test_an_operator_makes_its_mistake(operator: str, source: str, expected: set[tuple[str, str]]) -> None:
    assert operator in SECOND
    assert changes(source, operator) == expected
