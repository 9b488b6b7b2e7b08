"""Notebooks of the documentation print what they show; ``test_examples_wall.py`` runs the one that drives."""

import pytest

from tests import notebooks


@pytest.mark.timeout(300)
@pytest.mark.parametrize("name", notebooks.ALONE)
def test_a_notebook_prints_what_it_shows(name: str):
    assert notebooks.run(name) == notebooks.stored(name), "python -m tests.notebooks writes it anew"


def test_every_notebook_is_run():
    assert {file.stem for file in notebooks.FOLDER.glob("*.ipynb")} == {*notebooks.ALONE, "drive"}
