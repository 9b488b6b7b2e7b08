"""Names and words of the sources: one class a name, and the words of the field instead of private ones."""

import re
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[2]
SOURCES = [
    path
    for folder in ("monstertruckd", "drivers", "planners", "schemas", "systemd")
    for path in sorted((ROOT / folder).rglob("*.py"))
]
BENCHMARKS = sorted((ROOT / "benchmarks").rglob("*.py"))
TESTS = [
    path for path in sorted((ROOT / "tests").rglob("*.py")) if path.name not in ("test_names.py", "test_migrate.py")
]
"""All but this one, and the one of the keys that were renamed."""
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
PRIVATE = re.compile(
    r"(?<![a-z])(told|wish(es)?|hunt(s|ed)?|lookout|rungs?|ladder|mishaps?|patients?|thinning|nobody waits"
    r"|in vain|gone on with|turns? of the loop)(?![a-z])",
    re.IGNORECASE,
)
"""reported, request, search, path check, recovery behaviour, fault, host context, pruning, without waiting, failed,
resumed, iteration of the event loop"""
OLD_KEY = re.compile(r'^        "\w+\.[\w.*]+": "\w+",$')
"""A row of the table of keys that were renamed."""


def test_every_class_has_a_name_of_its_own():
    names = Counter(
        name
        for path in SOURCES
        for name in re.findall(r"^ *class (\w+)[:(\[]", path.read_text(encoding="utf-8"), re.MULTILINE)
    )
    assert names.total() > 1000
    assert [name for name, count in names.items() if count > 1] == []


def test_sources_benchmarks_tests_and_pages_use_the_words_of_the_field():
    found = [
        f"{path.relative_to(ROOT)}:{number}: {line}"
        for path in (*SOURCES, *BENCHMARKS, *TESTS, *PAGES)
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1)
        if PRIVATE.search(line) and not OLD_KEY.match(line)
    ]
    assert found == []
