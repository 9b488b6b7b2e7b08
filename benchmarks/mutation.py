"""Do the tests of the gate and of the way to standstill notice a fault? Single-point faults, one after the other.

    python benchmarks/mutation.py [--sample 600] [--seed 1] [--jobs N] [--file PART ...]
                                  [--operators first|second|both] [--minutes M] [--again] [--list]

Every mutant of the sources in ``TARGETS`` (operators: ``mutation_parts/mutants.py``; a second set, other mistakes:
``second.py``), or a seeded sample of them, meets
the unit tests that reach its function: those that found others there first, then those that reach its line, then the
quick ones; which tests reach a line is measured with coverage contexts and kept for each file of tests, so that a run
after a change measures those of the changed files alone. Mutants at a line that runs on import meet all tests of their
part, those that reach a line with the same names first. A mutant with which one test, or all of
them, take more than three times their time and 10 s is judged once more with ``PATIENCE`` times as long, and counted
apart if that is not enough either. Mutants are judged in the order drawn, so those
of a run that ended early (``--minutes``) are a sample as well. Results are kept, so an interrupted run goes on;
``--again`` judges survivors again.
``mutation_parts/equivalents.py`` lists mutants that no test can find, each with its reason; they do not count.
The score is killed of killed and survived, with its 95 % interval (Wilson).
"""

import argparse
import hashlib
import json
import math
import os
import re
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, ThreadPoolExecutor, wait
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np

from benchmarks import ROOT
from benchmarks.mutation_parts.equivalents import EQUIVALENTS
from benchmarks.mutation_parts.mutants import OPERATORS, Mutant, mutants
from benchmarks.mutation_parts.runner import (
    BROKEN,
    COLD,
    KILLED,
    OPTIONS,
    SURVIVED,
    TIMED_OUT,
    Server,
)
from benchmarks.mutation_parts.second import SECOND, second_mutants

TARGETS = {
    **{
        f"monstertruckd/gate/{name}.py": ("tests/unit/gate",)
        for name in (
            *("approach", "arbitration", "assist", "checks", "config", "consistency", "contact"),
            *("core", "docking", "fence", "following", "latch", "limiter", "motion"),
            *("obstacles", "own_checks", "peers", "rear_sonars", "runaway", "samples", "scan_memory"),
            *("sensors", "service", "sonars", "stops", "visibility", "zones"),
        )
    },
    **{
        f"drivers/monstertruck_drivers/{device}/{name}.py": (f"tests/unit/drivers/{device}",)
        for device, name in (("epos", "driver"), ("epos", "exchange"), ("maestro", "driver"), ("maestro", "session"))
    },
    "monstertruckd/bus/intake.py": ("tests/unit/bus",),
    "systemd/neutral.py": ("tests/unit/systemd",),
}  # fmt: skip
"""Sources, and the tests that are asked about them."""

GOAL = 0.97
MARGIN = 10.0
"""Seconds of processor time that tests of a mutant may take beyond three times their own."""
PATIENCE = 6
TOGETHER = 8
"""Files of tests that are measured in one process, and kept before the next ones."""
FIRST = 20
"""Tests whose files are imported first for a mutant that runs on import."""
COMMON = frozenset(("self", "Final", "None", "True", "False", "float", "Annotated", "Field", "Positive", "Reason"))
"""Words that say nothing about what a line is for."""
NO_TEST = "no test reaches it"
OUTPUT = ROOT / "runs" / "mutation.jsonl"
BASELINES = ROOT / "runs" / "mutation_baseline"
"""What each file of tests reaches, by the digest of it and of what it rests on."""


SETS = {"first": mutants, "second": second_mutants}
"""Finders by set of operators."""
Judgement = tuple[Mutant, str, str]
"""A mutant, its verdict, and the test that found it."""


@dataclass(frozen=True)
class Baseline:
    """Lines reached by the tests of the unmodified project."""

    lines: dict[str, dict[int, list[str]]]
    """Tests by file and line."""
    seconds: dict[str, float]
    """Duration of every test."""

    def tests(self, mutant: Mutant, sources: dict[str, bytes]) -> tuple[list[str], bool]:
        """Return the tests that reach a mutant's function, likely ones first, and whether its line runs on import."""
        lines = self.lines[mutant.file]
        found = set(lines.get(mutant.line) or lines.get(mutant.statement) or ())
        likely = set(found)
        if on_import := "" in found:
            found = {test for test in self.seconds if test.startswith(TARGETS[mutant.file])}
            text = sources[mutant.file].decode().splitlines()
            names = {name for name in re.findall(r"\w{4,}", text[mutant.statement - 1]) if name not in COMMON}
            for file, source in sources.items():
                for number, line in enumerate(source.decode().splitlines(), 1):
                    if names & set(re.findall(r"\w{4,}", line)):
                        likely.update(self.lines[file].get(number, ()))
        else:  # a tracer misses lines of a coroutine that an exception was thrown into
            found.update(test for line in mutant.scope for test in lines.get(line, ()) if test)
        return sorted(found, key=lambda test: (test not in likely, self.seconds[test], test)), on_import

    def first(self, tests: list[str], most: float) -> list[str]:
        """Return as many of the tests as take ``most`` seconds, at least one."""
        ends = np.cumsum([self.seconds[test] for test in tests])
        return tests[: max(int(np.searchsorted(ends, most)), 1)]


MEASURE = """
import json, sys
import coverage, pytest

class Durations:
    def __init__(self):
        self.seconds, self.failed = {}, []
    def pytest_runtest_logreport(self, report):
        self.seconds[report.nodeid] = self.seconds.get(report.nodeid, 0.0) + report.duration
        if report.failed:
            self.failed.append(report.nodeid)

out, files, tests = sys.argv[1], json.loads(sys.argv[2]), json.loads(sys.argv[3])
reported = Durations()
measured = coverage.Coverage(data_file=None, config_file=False, include=files)
measured.start()
class Contexts:
    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item):
        measured.switch_context(item.nodeid)
        try:
            return (yield)
        finally:
            measured.switch_context("")
pytest.main(tests, plugins=[reported, Contexts()])
measured.stop()
data = measured.get_data()
lines = {file: data.contexts_by_lineno(file) for file in data.measured_files()}
json.dump({"lines": lines, "seconds": reported.seconds, "failed": reported.failed}, open(out, "w"))
"""


def baseline_of(folders: Iterable[str], scratch: Path) -> Baseline:
    """Return the lines that the tests of some folders reach; unchanged test files are not run again."""
    files = [path for folder in sorted(folders) for path in sorted((ROOT / folder).rglob("test_*.py"))]
    kept = {path: BASELINES / f"{_digest_of(path)}.json" for path in files}
    todo = [path for path in files if not kept[path].exists()]
    BASELINES.mkdir(parents=True, exist_ok=True)
    for first in range(0, len(todo), TOGETHER):
        some = todo[first : first + TOGETHER]
        found = _measured(scratch / "baseline.json", some)
        for path in some:
            own = _of_file(found, str(path.relative_to(ROOT)))
            kept[path].write_text(json.dumps(own), encoding="utf-8")
    lines: dict[str, dict[int, list[str]]] = {file: {} for file in TARGETS}
    seconds: dict[str, float] = {}
    for path in files:
        own = json.loads(kept[path].read_text(encoding="utf-8"))
        seconds |= own["seconds"]
        for file, by_line in own["lines"].items():
            for line, tests in by_line.items():
                known = lines[file].setdefault(int(line), [])
                known += [test for test in tests if test or "" not in known]
    return Baseline(lines, seconds)


def _digest_of(path: Path) -> str:
    """Return a name for the lines reached by a test file: it depends on the tests, their helpers, and the targets."""
    digest = hashlib.blake2s(digest_size=12)
    common = (other for other in path.parent.glob("*.py") if not other.name.startswith("test_"))
    for source in (path, *sorted(common), *sorted((ROOT / "tests").glob("*.py")), *(ROOT / file for file in TARGETS)):
        digest.update(source.read_bytes())
    return digest.hexdigest()


def _of_file(found: dict[str, dict[str, Any]], file: str) -> dict[str, Any]:
    """Return the share of one test file; lines that run on import belong to all of them."""
    lines = {
        target: {line: [t for t in tests if not t or t.startswith(f"{file}::")] for line, tests in by_line.items()}
        for target, by_line in found["lines"].items()
    }
    return {
        "lines": {target: {n: tests for n, tests in by_line.items() if tests} for target, by_line in lines.items()},
        "seconds": {test: spent for test, spent in found["seconds"].items() if test.startswith(f"{file}::")},
    }


def _measured(out: Path, tests: Iterable[Path]) -> dict[str, dict[str, Any]]:
    """Run test files once; return lines by target with the tests that reach them, and the seconds of every test."""
    files = [str(ROOT / file) for file in TARGETS]
    subprocess.run(
        [sys.executable, "-c", MEASURE, str(out), json.dumps(files), json.dumps([*OPTIONS, *map(str, tests)])],
        cwd=ROOT, check=True, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    found = json.loads(out.read_text(encoding="utf-8"))
    failed = set(found["failed"])
    if failed:
        print(f"left out, for they fail without any fault: {', '.join(sorted(failed))}", file=sys.stderr)
    lines = {
        str(Path(file).relative_to(ROOT)): {
            line: [test for test in reached if test not in failed] for line, reached in by_line.items()
        }
        for file, by_line in found["lines"].items()
    }
    return {"lines": lines, "seconds": {t: spent for t, spent in found["seconds"].items() if t not in failed}}


def interval(killed: int, total: int) -> tuple[float, float]:
    """Return the 95 % interval of a share (Wilson)."""
    if total == 0:
        return 0.0, 1.0
    z, share = 1.96, killed / total
    middle = (share + z**2 / (2 * total)) / (1 + z**2 / total)
    half = z / (1 + z**2 / total) * math.sqrt(share * (1 - share) / total + z**2 / (4 * total**2))
    return max(middle - half, 0.0), min(middle + half, 1.0)


def digest(source: bytes, mutant: Mutant) -> str:
    """Return a name for a mutant of exactly this source."""
    return hashlib.blake2s(source + repr((mutant.span, mutant.after)).encode(), digest_size=10).hexdigest()


def known(file: Path, *, again: bool) -> dict[str, dict[str, str]]:
    """Return the verdicts of earlier runs; with ``again`` without the survivors."""
    lines = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
    verdicts = {entry["id"]: entry for entry in map(json.loads, lines)}
    return {name: entry for name, entry in verdicts.items() if not (again and entry["verdict"] in (SURVIVED, NO_TEST))}


def sample(every: list[Mutant], count: int, seed: int) -> list[Mutant]:
    """Draw this many mutants with a seed, in the order drawn; 0: all of them.

    The position of a mutant depends only on itself: an edit elsewhere leaves it in the sample.
    """
    seen: Counter[str] = Counter()

    def place(mutant: Mutant) -> bytes:
        seen[mutant.key] += 1
        return hashlib.blake2s(repr((seed, mutant.key, seen[mutant.key])).encode()).digest()

    return sorted(every, key=place)[: count or None]


def judged(
    todo: list[Mutant], sources: dict[str, bytes], options: argparse.Namespace, scratch: Path
) -> Iterator[Judgement]:
    """Yield the verdict of every mutant that the time allows, and the test that killed it."""
    end = time.monotonic() + 60 * options.minutes
    tests = sorted({test for mutant in todo for test in TARGETS[mutant.file]})
    baseline = baseline_of(tests, scratch)
    print(f"{len(baseline.seconds)} tests, {sum(baseline.seconds.values()):.0f} s", file=sys.stderr)
    every = {file: (ROOT / file).read_bytes() for file in TARGETS}
    idle: SimpleQueue[dict[str, Server]] = SimpleQueue()
    servers = [{kind: Server(kind, tests) for kind in ("warm", "cold")} for _ in range(options.jobs)]
    for pair in servers:
        _check(pair, baseline, sources)
        idle.put(pair)

    killers: defaultdict[tuple[str, str], Counter[str]] = defaultdict(Counter)

    def judge(mutant: Mutant) -> Judgement:
        reached, on_import = baseline.tests(mutant, every)
        if not reached:
            return mutant, NO_TEST, ""
        before = killers[mutant.file, mutant.where]
        reached = baseline.first(sorted(reached, key=lambda test: -before[test]), options.most)
        sound, faulty = sources[mutant.file].decode(), mutant.applied(sources[mutant.file]).decode()
        limits = {test: 3 * baseline.seconds[test] + MARGIN for test in reached}
        seconds = 3 * sum(baseline.seconds[test] for test in reached) + MARGIN
        pair = idle.get()
        try:
            for patience in (1, PATIENCE):
                verdict, test = COLD, ""
                longest = {name: limit * patience for name, limit in limits.items()}
                if not on_import:
                    verdict, test = pair["warm"].judge(mutant.file, sound, faulty, longest, seconds * patience)
                if verdict == COLD:
                    for chosen in (dict(islice(longest.items(), FIRST)), longest):
                        verdict, test = pair["cold"].judge(mutant.file, sound, faulty, chosen, seconds * patience)
                        if verdict != SURVIVED:
                            break
                if verdict != TIMED_OUT:
                    break
            before[test] += 1
            return mutant, verdict, test
        finally:
            idle.put(pair)

    with ThreadPoolExecutor(options.jobs) as pool:
        yield from _until(end, pool, judge, todo, options.jobs)
    for pair in servers:
        for server in pair.values():
            server.close()


def _until(
    end: float, pool: Executor, judge: Callable[[Mutant], Judgement], todo: Iterable[Mutant], jobs: int
) -> Iterator[Judgement]:
    """Yield judgements started before ``end``, as they are completed."""
    waiting = iter(todo)
    running = {pool.submit(judge, mutant) for mutant in islice(waiting, jobs)}
    while running:
        done, running = wait(running, return_when=FIRST_COMPLETED)
        for judgement in done:
            yield judgement.result()
            if time.monotonic() < end and (mutant := next(waiting, None)) is not None:
                running.add(pool.submit(judge, mutant))


def _check(pair: dict[str, Server], baseline: Baseline, sources: dict[str, bytes]) -> None:
    """Check that a server finds no fault in an unmodified source."""
    file, source = next(iter(sources.items()))
    test = next(test for test in baseline.seconds if test.startswith(TARGETS[file]))
    for kind, server in pair.items():
        if (verdict := server.judge(file, source.decode(), source.decode(), {test: 120.0}, 120.0)[0]) != SURVIVED:
            sys.exit(f"{test} of the sound project, {kind}: {verdict}")


def main() -> int:
    """Judge the mutants; 0: the goal is met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sample", type=int, default=600, help="mutants drawn; 0 = all")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=max((os.cpu_count() or 2) - 1, 1))
    parser.add_argument("--file", nargs="*", default=[""], help="only sources whose name contains one of these")
    parser.add_argument("--results", type=Path, default=OUTPUT, help="JSON lines, kept from run to run")
    parser.add_argument("--again", action="store_true", help="judge earlier survivors again, as after new tests")
    parser.add_argument("--minutes", type=float, default=math.inf, help="end after this time with what is judged")
    parser.add_argument("--most", type=float, default=math.inf, help="seconds of tests for each: a lower bound")
    parser.add_argument("--operators", choices=(*SETS, "both"), default="both", help="which set of them")
    parser.add_argument("--list", action="store_true", help="print the mutants and end")
    options = parser.parse_args()
    sources = {file: (ROOT / file).read_bytes() for file in TARGETS if any(part in file for part in options.file)}
    find = [finder for name, finder in SETS.items() if options.operators in (name, "both")]
    every = [mutant for file, source in sources.items() for finder in find for mutant in finder(file, source)]
    countable = [mutant for mutant in every if mutant.key not in EQUIVALENTS]
    chosen = sample(countable, options.sample, options.seed)
    if options.list:
        for mutant in chosen:
            print(f"{mutant.file}:{mutant.line} [{mutant.operator}] {mutant.where}: {mutant.before} -> {mutant.after}")
        return 0
    options.results.parent.mkdir(parents=True, exist_ok=True)
    before = known(options.results, again=options.again)
    ids = {mutant: digest(sources[mutant.file], mutant) for mutant in chosen}
    verdicts = {mutant: before[ids[mutant]]["verdict"] for mutant in chosen if ids[mutant] in before}
    todo = [mutant for mutant in chosen if mutant not in verdicts]
    print(f"{len(every)} mutants, {len(every) - len(countable)} equivalent, {len(chosen)} drawn, {len(todo)} to judge")
    with tempfile.TemporaryDirectory(prefix="mutation-") as scratch, options.results.open("a") as kept:
        for mutant, verdict, test in judged(todo, sources, options, Path(scratch)) if todo else ():
            verdicts[mutant] = verdict
            entry = {"id": ids[mutant], "verdict": verdict, "test": test, "mutant": mutant.key, "line": mutant.line}
            print(json.dumps(entry), file=kept, flush=True)
    return report(verdicts, len(every), len(every) - len(countable))


def report(verdicts: dict[Mutant, str], total: int, equivalent: int) -> int:
    """Print survivors, the score of every operator and the sums; 0: the goal is met."""
    for mutant, verdict in verdicts.items():
        if verdict in (SURVIVED, NO_TEST):
            print(
                f"{verdict}: {mutant.file}:{mutant.line} [{mutant.operator}] {mutant.where}: "
                f"{mutant.before} -> {mutant.after}"
            )
    counts = Counter(verdicts.values())
    killed = counts[KILLED] + counts[BROKEN]
    lived = counts[SURVIVED] + counts[NO_TEST]
    for operator in (*OPERATORS, *SECOND):
        own = Counter(verdict for mutant, verdict in verdicts.items() if mutant.operator == operator)
        print(f"{operator:12} {own[KILLED] + own[BROKEN]:5} killed {own[SURVIVED] + own[NO_TEST]:4} survived")
    score = killed / max(killed + lived, 1)
    low, high = interval(killed, killed + lived)
    figures = {
        "mutants": total,
        "equivalent": equivalent,
        "judged": len(verdicts),
        "killed": killed,
        "survived": lived,
        "timed_out": counts[TIMED_OUT],
        "score": round(score, 4),
        "score_low": round(low, 4),
        "score_high": round(high, 4),
    }
    met = score >= GOAL
    print(json.dumps({"bench": "mutation", "figures": figures, "goals": {"score": GOAL}, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
