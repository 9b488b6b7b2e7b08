"""Page, terminal and documentation use one word for one thing: the glossary's."""

import json
import re
from pathlib import Path

import pytest

from monstertruckd.tools.cli.main import app
from tests.unit.docs.command_lines import commands_of, resolve

ROOT = Path(__file__).resolve().parents[3]
ROWS = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8").splitlines()
    if line.startswith("| ") and not line.startswith("| word")
]
OTHER_WORDS = {
    "behaviour": r"behaviors?",
    "costmap": r"cost maps?",
    "deadman": r"dead[- ]man",
    "emergency stop": r"e-stops?|emergency halt",
    "gamepad": r"joy ?pads?|game pads?",
    "keepout": r"keep-out|no-go",
    "set-point": r"set ?points?",
    "stamp": r"time ?stamps?|time-stamps?",
    "timeout": r"time-outs?",
    "waypoint": r"way[- ]points?|via[- ]points?",
    "Wi-Fi": r"wifi|WLAN",
}
"""Words that mean the same as the key, which is the one in use."""


def _texts() -> dict[str, str]:
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
    prose = {str(page.relative_to(ROOT)): _without_code(page.read_text(encoding="utf-8")) for page in pages}
    strings = ROOT / "monstertruckd" / "station" / "page" / "strings" / "en.json"
    prose["the page's texts"] = "\n".join(json.loads(strings.read_text(encoding="utf-8")).values())
    helps = [resolve(list(name))[0] for name in commands_of(app)]
    prose["help texts"] = "\n".join(
        text for found in helps for text in (found.help, *(getattr(p, "help", "") for p in found.params)) if text
    )
    return prose


def _without_code(markdown: str) -> str:
    return re.sub(r"^```.*?^```|^    .*?$|`[^`\n]*`|\]\([^)]*\)", "", markdown, flags=re.MULTILINE | re.DOTALL)


TEXTS = _texts()


def test_terms_are_explained_once_and_in_order():
    terms = [term for word, _ in ROWS for term in word.split(", ")]
    assert len(ROWS) > 30
    assert len(terms) == len(set(terms))
    first = [word.strip("`").casefold() for word, _ in ROWS]
    assert first == sorted(first)


@pytest.mark.parametrize(("word", "others"), OTHER_WORDS.items(), ids=OTHER_WORDS)
def test_one_thing_has_one_word(word: str, others: str):
    pattern = re.compile(rf"\b({others})\b", re.IGNORECASE)
    found = [f"{place}: {hit[0]}" for place, text in TEXTS.items() for hit in pattern.finditer(text)]
    assert found == [], f"write {word}"
