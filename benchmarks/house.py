"""The size of the house: numbers, kinds of paths and poses, core and rest, short files, table cells.

    python benchmarks/house.py [--list]

Reads the sources as text and syntax trees: the files tracked by git in the packages, without tests, benchmarks and
docs. ``--list`` prints the counted items. The last line is JSON.

*Places to change* are the files changed by one more of a kind, beside its own: for the trial changes made and run by
``tests/daemon/test_trial_changes.py``; for trackers and explorers, the files that name a present one. A *module number*
is an assignment at module level whose value is made of numbers: a literal, arithmetic with a literal, or a tuple of
these. A *reader* of a file is a file of the packages or of ``systemd`` that imports it; a file named by a catalog row
(``module:name``) stays a file of its kind. *Core* is what a robot needs to own its devices, estimate, map, plan, track,
be stopped, be recorded and be operated; ``REST`` names everything else. A file may hold one number for every 100 lines
begun: a file of fewer than 100 lines cannot hold a part of a number.
"""

import argparse
import ast
import json
import math
import re
import subprocess
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

from benchmarks import ROOT
from tests.trial_changes import TRIALS

PACKAGES: Final = ("monstertruckd", "drivers", "planners", "schemas")
USERS: Final = (*PACKAGES, "systemd")
"""Folders whose files read the packages' modules."""
FACTS: Final = ("protocol.py", "objects.py")
"""Names of files that hold numbers of manuals, each with its source."""
SHORT: Final = 60
"""Lines of a file that could be a part of its only reader."""
NAMED_ALIKE: Final = 2
"""Files that may have a module number of the same name."""
LIMITS: Final = {"module_numbers_per_1000_lines": 6.0, "path_types": 4}
DENSEST: Final = 10
"""Module numbers per 1000 lines of a file."""
CELL: Final = 200
"""Characters of a table cell of the documentation."""
REST: Final = (
    "drivers/monstertruck_drivers/arduino_bridge",
    "drivers/monstertruck_drivers/bno085",
    "drivers/monstertruck_drivers/ld19",
    "drivers/monstertruck_drivers/receiver",
    "drivers/monstertruck_drivers/roboclaw",
    "drivers/monstertruck_drivers/rplidar",
    "drivers/monstertruck_drivers/sheet_lidar",
    "drivers/monstertruck_drivers/srf08",
    "drivers/monstertruck_drivers/steppers",
    "drivers/monstertruck_drivers/vesc",
    "drivers/monstertruck_drivers/wt61",
    "drivers/monstertruck_sim",
    "monstertruckd/ros2",
    "monstertruckd/station/foxglove.py",
    "monstertruckd/tools/cli/description.py",
    "monstertruckd/tools/cli/drill.py",
    "monstertruckd/tools/cli/kinematics.py",
    "monstertruckd/tools/cli/replay.py",
    "monstertruckd/tools/cli/ros2.py",
    "monstertruckd/tools/cli/stand",
    "monstertruckd/tools/cli/study.py",
    "monstertruckd/tools/cli/tune.py",
    "monstertruckd/tools/demo",
    "monstertruckd/tools/drill",
    "monstertruckd/tools/logs/animation.py",
    "monstertruckd/tools/logs/live",
    "monstertruckd/tools/logs/rerun_view.py",
    "monstertruckd/tools/logs/ros2.py",
    "monstertruckd/tools/replay_check",
    "monstertruckd/tools/simulation",
    "monstertruckd/tools/stand",
    "monstertruckd/tools/study",
    "monstertruckd/tools/tune",
    "planners/monstertruck_kinematics/families.py",
    "planners/monstertruck_planners/behave/wall",
)
"""Beginnings of the paths of files that a robot does not need to do its work."""
PATH_TYPE: Final = re.compile(
    r"Path|PathSteps|Segment|Reference|PlanAnswer|RouteInWindow|LocalRoute|\w+Path|Segmented\w+"
)
POSE_TYPE: Final = re.compile(r"_?(Pose|Pose2|Pose2D|Twist|Twist2|Vector)")
MESSAGES: Final = "schemas/monstertruck_schemas/"
EXAMPLES: Final = {
    "tracker": r"[Ff]uzzy",
    "explorer": r"AuthorConfig|:Author\b|class Author\b",
}
"""A present example of each kind for which no trial is written, by the names that belong to it alone."""
PLACES: Final = {
    "wizard": 1,
    "tracker": 3,
    "motor_controller": 1,
    "body": 2,
    "task": 1,
    "sensor_role": 4,
    "page_panel": 2,
}
"""Files that a change may touch, beside its own."""
PLACES_OF_PATHS: Final = ("planners/", MESSAGES)
"""Where classes of such names are paths to be driven, not names of files."""


class Source(NamedTuple):
    """One file."""

    path: str
    """From the root."""
    lines: int
    tree: ast.Module


def sources(folders: Iterable[str] = PACKAGES) -> list[Source]:
    """Return all files of the packages."""
    names = subprocess.run(
        ["git", "ls-files", "--", *(f"{folder}/*.py" for folder in folders)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    texts = ((name, (ROOT / name).read_text()) for name in names)
    return [Source(name, len(text.splitlines()), ast.parse(text)) for name, text in texts]


def is_number(value: ast.expr) -> bool:
    """Whether an expression is made of numbers."""
    match value:
        case ast.Constant(value=constant):
            return isinstance(constant, int | float) and not isinstance(constant, bool)
        case ast.UnaryOp(operand=operand):
            return is_number(operand)
        case ast.BinOp(left=left, right=right):
            return is_number(left) or is_number(right)
        case ast.Tuple(elts=parts) | ast.List(elts=parts):
            return bool(parts) and all(map(is_number, parts))
    return False


def module_numbers(tree: ast.Module) -> Iterator[str]:
    """Yield the names of a file's module numbers."""
    for statement in tree.body:
        match statement:
            case ast.Assign(targets=[ast.Name(id=name)], value=value) if is_number(value):
                yield name
            case ast.AnnAssign(target=ast.Name(id=name), value=ast.expr() as value) if is_number(value):
                yield name


def defined_types(tree: ast.Module) -> Iterator[str]:
    """Yield the names of a file's classes and type aliases."""
    for statement in tree.body:
        match statement:
            case ast.ClassDef(name=name):
                yield name
            case ast.Assign(targets=[ast.Name(id=name)], value=ast.Subscript() | ast.Name() | ast.BinOp()):
                yield name


def conversions(tree: ast.Module, types: set[str]) -> Iterator[str]:
    """Yield functions that take one of ``types`` and return another one."""
    for function in ast.walk(tree):
        if not isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef) or function.returns is None:
            continue
        given = {name for argument in function.args.args for name in named(argument.annotation)} & types
        returned = set(named(function.returns)) & types
        if given and returned - given:
            yield function.name


def named(annotation: ast.expr | None) -> Iterator[str]:
    """Yield the names in an annotation."""
    for node in ast.walk(annotation) if annotation is not None else ():
        if isinstance(node, ast.Name):
            yield node.id


def configuration_fields(files: list[Source]) -> int:
    """Count the fields of the settings: models that derive from ``Schema`` outside the messages."""
    trees = [source.tree for source in files if not source.path.startswith(MESSAGES)]
    classes = [node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    models, before = {"Schema"}, 0
    while len(models) > before:
        before = len(models)
        models |= {model.name for model in classes if any(set(named(base)) & models for base in model.bases)}
    return sum(isinstance(part, ast.AnnAssign) for model in classes if model.name in models for part in model.body)


def module_of(path: str) -> str:
    """Return the dotted name of a file's module."""
    parts = Path(path).with_suffix("").parts
    return ".".join(parts if parts[0] == "monstertruckd" else parts[1:]).removesuffix(".__init__")


def readers(files: list[Source]) -> dict[str, set[str]]:
    """Return, for each module, the files that import it."""
    modules, found = {module_of(source.path) for source in files}, defaultdict(set)
    for source in sources(USERS):
        for node in ast.walk(source.tree):
            match node:
                case ast.Import(names=aliases):
                    imported = [alias.name for alias in aliases]
                case ast.ImportFrom(module=str() as module, names=aliases):
                    inner = [f"{module}.{alias.name}" for alias in aliases]
                    imported = [name if name in modules else module for name in inner]
                case _:
                    continue
            for name in modules.intersection(imported):
                found[name].add(source.path)
    return found


def placed(files: list[Source]) -> set[str]:
    """Return the modules that catalog rows name (``module:name``): the catalog loads them on use."""
    texts = (node.value for source in files for node in ast.walk(source.tree) if isinstance(node, ast.Constant))
    return {text.partition(":")[0] for text in texts if isinstance(text, str) and re.fullmatch(r"[\w.]+:\w+", text)}


def longest_cell() -> tuple[int, str]:
    """Return the characters of the longest table cell of the documentation, and its page."""
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    return max(
        (len(cell.strip()), str(page.relative_to(ROOT)))
        for page in pages
        for line in page.read_text().splitlines()
        if line.startswith("|")
        for cell in re.split(r"(?<!\\)\|", line)
    )


def main() -> None:
    """Count, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--list", action="store_true", help="print what was counted")
    options = parser.parse_args()
    files = sources()
    lines = sum(source.lines for source in files)
    numbers = {source.path: list(module_numbers(source.tree)) for source in files}
    counted = sum(map(len, numbers.values()))
    dense = {
        source.path: 1000 * len(numbers[source.path]) / source.lines
        for source in files
        if source.lines and Path(source.path).name not in FACTS
    }
    homes = Counter(name for names in numbers.values() for name in set(names))
    paths = sorted(
        {
            f"{source.path}:{name}"
            for source in files
            if source.path.startswith(PLACES_OF_PATHS)
            for name in defined_types(source.tree)
            if PATH_TYPE.fullmatch(name)
        }
    )
    poses = sorted(
        f"{source.path}:{name}" for source in files for name in defined_types(source.tree) if POSE_TYPE.fullmatch(name)
    )
    types = {name.partition(":")[2] for name in (*paths, *poses)}
    converting = [f"{source.path}:{name}" for source in files for name in conversions(source.tree, types)]
    read_by, loaded = readers(files), placed(files)
    lonely = sorted(
        source.path
        for source in files
        if source.lines < SHORT
        and not source.path.endswith(("__init__.py", "_pb2.py"))
        and len(read_by[module_of(source.path)]) == 1
        and module_of(source.path) not in loaded
    )
    rest = sum(source.lines for source in files if source.path.startswith(REST))
    cell, page = longest_cell()
    alike = {name: count for name, count in homes.items() if count > NAMED_ALIKE}
    changes = places(files)
    if options.list:
        for title, rows in (
            *((f"places to change for one more {kind}", names) for kind, names in changes.items()),
            ("path types", paths),
            ("pose types", poses),
            ("conversions", converting),
            ("short files with one reader", lonely),
            ("module numbers per 1000 lines", [f"{per:5.0f} {path}" for path, per in by_size(dense)[:40]]),
            ("module numbers of one name", [f"{count:3} files: {name}" for name, count in by_size(alike)]),
        ):
            print(f"\n{title}: {len(rows)}", *rows, sep="\n  ")
        print(f"\nlongest table cell: {cell} characters in {page}\n")
    figures: dict[str, Any] = {
        "files": len(files),
        "lines": lines,
        "core_lines": lines - rest,
        "rest_lines": rest,
        "module_numbers": counted,
        "module_numbers_per_1000_lines": round(1000 * counted / lines, 1),
        "most_in_a_file_per_1000_lines": round(max(dense.values()), 1),
        "files_over_10_per_1000_lines": sum(per > DENSEST for per in dense.values()),
        "files_over_it_by_a_whole_number": sum(
            len(numbers[source.path]) > math.ceil(source.lines * DENSEST / 1000)
            for source in files
            if source.path in dense
        ),
        "module_numbers_of_one_name": len(alike),
        "configuration_fields": configuration_fields(files),
        "path_types": len(paths),
        "pose_types": len(poses),
        "conversions": len(converting),
        "short_files_with_one_reader": len(lonely),
        "longest_cell": cell,
        "places_to_change": {kind: len(names) for kind, names in changes.items()},
    }
    goals: dict[str, Any] = {
        **LIMITS,
        "files_over_it_by_a_whole_number": 0,
        "module_numbers_of_one_name": 0,
        "short_files_with_one_reader": 0,
        "longest_cell": CELL,
    }
    met = all(figures[name] <= goal for name, goal in goals.items())
    met = met and all(len(changes[kind]) <= goal for kind, goal in PLACES.items())
    goals["places_to_change"] = PLACES
    print(json.dumps({"bench": "house", "figures": figures, "goals": goals, "met": met}))


def places(files: list[Source]) -> dict[str, list[str]]:
    """Return, for each kind of change, the files of its trial, or those that name its example."""
    found = {kind: trial().places for kind, trial in TRIALS.items()}
    for kind, pattern in EXAMPLES.items():
        named_in = [source.path for source in files if re.search(pattern, (ROOT / source.path).read_text())]
        own = {str(Path(path).parent) for path in named_in if re.search(pattern, Path(path).parent.name)}
        found[kind] = sorted(
            {next((folder for folder in own if path.startswith(f"{folder}/")), path) for path in named_in}
        )
    return found


def by_size(counts: dict[str, float] | dict[str, int]) -> list[tuple[str, float]]:
    """Return the items, the largest first."""
    return sorted(counts.items(), key=lambda item: -item[1])


if __name__ == "__main__":
    main()
