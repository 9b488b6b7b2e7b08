"""The byte fuzzer of the benchmarks on every parser, with fewer bytes."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

FILE = Path(__file__).resolve().parents[3] / "benchmarks" / "fuzz.py"


@pytest.fixture(scope="module")
def fuzz() -> ModuleType:
    spec = importlib.util.spec_from_file_location("fuzz_benchmark", FILE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def test_no_parser_fails_grows_or_loses_its_step(fuzz: ModuleType):
    results = fuzz.run(100_000, 5, [])
    assert len(results) == 11
    assert {name: figures for name, figures in results.items() if not figures["ok"]} == {}


def test_a_parser_that_raises_grows_or_stays_lost_is_found(fuzz: ModuleType, monkeypatch: pytest.MonkeyPatch):
    class Greedy:
        def __init__(self) -> None:
            self.kept = bytearray()

        def feed(self, data: bytes) -> list[bytes]:
            self.kept += data
            return []

    def raises(data: bytes) -> None:
        raise KeyError(data)

    bad = {
        "greedy": fuzz.Stream(Greedy, [(b"abc", b"abc")]),
        "fragile": fuzz.Whole(raises, (ValueError,), [b"abc"]),
    }
    monkeypatch.setattr(fuzz, "parsers", lambda: bad)
    results = fuzz.run(100, 1, list(bad))
    assert results["greedy"]["lost"] == fuzz.FRAMES
    assert results["greedy"]["held"] > 4096
    assert not results["greedy"]["ok"]
    assert "KeyError" in results["fragile"]["raised"]
