"""A swapped cable or a wrong sign is named by the wizard that meets it; 20 of each are the benchmark's."""

import pytest

from monstertruckd.config.wizards import WIZARDS
from tests.calibration_wrong import WRONG, noticed


def test_every_wizard_has_one():
    assert WRONG.keys() == WIZARDS.keys()


@pytest.mark.parametrize("wizard", WRONG)
def test_it_is_named(wizard: str):
    assert noticed(wizard, 2) == 2
