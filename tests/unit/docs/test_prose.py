"""Sentences keep their actors: the turns of phrase that ``benchmarks/prose.py`` counts do not become more."""

import pytest

from benchmarks.prose import FileCount, counted, figures_of, hits, units

MOST = {"per_1000_words": 2.0, "files_above": 3}
"""Figures of the last rewrite: lower them with the text, never raise them."""


def test_new_text_adds_no_turns_of_phrase():
    _, by_file = counted()
    assert {name: value for name, value in figures_of(by_file).items() if value > MOST[name]} == {}, (
        "python benchmarks/prose.py --list prints every place"
    )


@pytest.mark.parametrize(
    ("sentence", "label"),
    [
        ("Reports what was measured.", "clause with what in place of a noun"),
        ("The way by which it came.", "preposition with which"),
        ("The newest scan.", "newest, present"),
        ("It is said so once.", "texts that say"),
        ("Somebody arms it anew.", "actor without a name"),
        ("None = not known.", "equals sign for a condition"),
    ],
)
def test_a_turn_of_phrase_is_found(sentence: str, label: str):
    assert label in {found for found, _ in hits(sentence)}


def test_prose_of_python_is_docstrings_comments_and_texts_but_not_code():
    text = 'def go():\n    """Of the robot, m."""\n    x = "a b c"  # because the bus waits\n    return "a"\n'
    assert sorted(units("go.py", text)) == ['"""Of the robot, m.', "a b c", "because the bus waits"]
    assert [label for label, _ in hits('"""Of the robot, m.')] == ["docstring without a head"]


def test_prose_of_a_page_leaves_code_out():
    assert list(units("page.md", "One.\n```\ncode\n```\n    more code\nTwo.")) == ["One.", "Two."]


def test_rates_of_short_files_are_not_judged():
    files = {"short": FileCount(5, 100), "long": FileCount(5, 400), "good": FileCount(0, 500)}
    assert figures_of(files) == {"per_1000_words": 10.0, "files_above": 1}
