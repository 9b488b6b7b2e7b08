"""Of tests with many parameters: which are part of `check`, and which are long."""

from collections.abc import Collection, Iterable
from typing import Any

import pytest


def mostly_long(cases: Iterable[Any], kept: Collection[Any]) -> list[Any]:
    """Parameters, of which only the ``kept`` ones are part of `check`.

    Raises:
        ValueError: one of the kept is no case.
    """
    cases = list(cases)
    if missing := [case for case in kept if case not in cases]:
        raise ValueError(f"no such cases: {missing}")
    return [
        case if case in kept else pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.long)
        for case in cases
    ]
