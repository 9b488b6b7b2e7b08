"""For every test: the product's event loop, no leaked tasks, and what is the same for all of them made once."""

import asyncio
import gc
import inspect
import os
import re
from collections.abc import AsyncIterator, Callable, Generator
from copy import deepcopy
from functools import cache, lru_cache
from pathlib import Path

import pytest
import uvloop

UNIT = Path(__file__).parent / "unit"
CONFIGS = Path(__file__).resolve().parents[1] / "configs"
TRACED = (("schemas",), ("gate",), ("runtime", "wire"))
"""Folders of unit tests."""
WIRE_FORMATS = re.compile(r"(?:/|def test_|class Test)\w*(?:protocol|parser|codec)")
"""In the place of a file below the drivers' tests, or in a line of it: tests of wire formats."""


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Which files need not be imported, as none of their tests is wanted: all together take 10 s."""
    wanted = config.getoption("markexpr")
    if "not traced" in wanted and collection_path.is_dir() and _below(collection_path) in TRACED:
        return True
    if (
        wanted.startswith("traced")
        and collection_path.match("test_*.py")
        and _below(collection_path)[:1] == ("drivers",)
    ):
        return not WIRE_FORMATS.search(f"{collection_path}\n{collection_path.read_text(encoding='utf-8')}") or None
    mark = wanted.removesuffix(" and not long")
    if mark not in ("virtual", "wall") or not collection_path.match("test_*.py"):
        return None
    return f"mark.{mark}" not in collection_path.read_text(encoding="utf-8") or None


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Let the garbage collector leave out what is imported and collected: it lasts, and to look at it again and again
    took a tenth of the tests' time.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of the parts whose coverage is a gate: they run under the tracer, which would slow all others."""
    _make_once()
    for item in items:
        if inspect.iscoroutinefunction(getattr(item, "obj", None)):
            item.fixturenames.insert(0, "no_leaked_tasks")  # type: ignore[attr-defined]  # others have no loop
        below = _below(item.path)
        place = f"/{item.nodeid.partition('[')[0].replace('::test_', '::def test_').replace('::Test', '::class Test')}"
        wire_format = below[:1] == ("drivers",) and WIRE_FORMATS.search(place) is not None
        if wire_format or any(below[: len(folder)] == folder for folder in TRACED):
            item.add_marker("traced")


def _make_once() -> None:
    """Parse a configuration file once (0.1 s), merge a shipped one with its includes once (20 ms), and build the tree
    of commands once (40 ms).

    Imported here and not above, where the tracer of a worker would not yet see it.
    """
    import typer.testing

    from monstertruckd.config import load

    load._compose = lru_cache(maxsize=256)(load._compose)
    read, shipped = load._load, {}

    def load_once(path: Path, including: tuple[Path, ...], inherited: int | None) -> load.Tree:
        place = Path(os.path.realpath(path))
        if not place.is_relative_to(CONFIGS) or place in including:
            return read(path, including, inherited)
        if (path, inherited) not in shipped:
            shipped[path, inherited] = read(path, including, inherited)
        tree = shipped[path, inherited]
        return load.Tree(deepcopy(tree.data), dict(tree.origins), list(tree.files))

    load._load = load_once
    typer.testing._get_command = cache(typer.testing._get_command)


@cache
def _below(path: Path) -> tuple[str, ...]:
    """Of a path below the unit tests; of others none."""
    return path.relative_to(UNIT).parts if path.is_relative_to(UNIT) else ()


def pytest_asyncio_loop_factories() -> dict[str, Callable[[], asyncio.AbstractEventLoop]]:
    """Run coroutines on the loop the product runs on."""
    return {"uvloop": uvloop.new_event_loop}


@pytest.fixture
async def no_leaked_tasks() -> AsyncIterator[None]:
    """Fail a test that leaves asyncio tasks running."""
    before = asyncio.all_tasks()
    yield
    await asyncio.sleep(0)
    leaked = {t for t in asyncio.all_tasks() - before - {asyncio.current_task()} if not t.done()}
    assert not leaked, f"tasks left running: {leaked}"
