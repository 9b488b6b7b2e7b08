"""Angles as people write them."""

import math

import pytest
import typer

from monstertruck_runtime.errors import InputError
from monstertruckd.station import commands
from monstertruckd.tools.cli.options import parse_angle, parse_heading, parse_pose


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("90", math.pi / 2),
        ("-90deg", -math.pi / 2),
        ("45°", math.pi / 4),
        ("1.5rad", 1.5),
        ("360", math.tau),
        ("2e1", math.radians(20)),
    ],
)
def test_degrees_are_the_default_and_radians_are_named(text: str, expected: float):
    assert parse_heading(text) == pytest.approx(expected)
    assert parse_pose(f"1,2,{text}") == pytest.approx((1.0, 2.0, expected))


@pytest.mark.parametrize("text", ["", "deg", "ninety", "90 turns", "90grad"])
def test_other_words_are_refused(text: str):
    with pytest.raises(typer.BadParameter, match=r"expected degrees, or radians such as 1\.57rad"):
        parse_angle(text)


@pytest.mark.parametrize("text", ["361", "-400deg", "6.3rad", "90rad"])
def test_more_than_one_turn_is_no_heading(text: str):
    with pytest.raises(InputError, match=r"at most one turn, 360 degrees or 6\.283rad"):
        parse_heading(text)
    with pytest.raises(InputError, match="at most one turn"):
        parse_pose(f"1,2,{text}")
    assert abs(parse_angle(text)) > math.tau, "a turn may be longer"


def test_the_page_sends_no_heading_of_more_than_one_turn():
    assert commands.parse('{"do": "goal", "id": 1, "goal": [1, 2, -3.1]}')
    with pytest.raises(InputError, match="goal"):
        commands.parse('{"do": "goal", "id": 1, "goal": [1, 2, 90]}')
