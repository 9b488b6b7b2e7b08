"""Posts that a person puts into the world of an emulated robot."""

from types import SimpleNamespace

import pytest

from monstertruck_runtime.errors import InputError
from monstertruck_sim.world.obstacles import Disc
from monstertruckd.tools.simulation.simulate import MOST_POSTS, EmulatedRoom

RADIUS = 0.1


class Space:
    def __init__(self) -> None:
        self.obstacles: list[Disc] = []

    def truth(self, _: int) -> SimpleNamespace:
        return SimpleNamespace(x=1.0, y=2.0, yaw=0.0)

    def add(self, _: int, obstacle: Disc) -> None:
        self.obstacles.append(obstacle)

    def remove(self, _: int, obstacle: Disc) -> None:
        self.obstacles.remove(obstacle)


@pytest.fixture
def space() -> Space:
    return Space()


@pytest.fixture
def room(space: Space) -> EmulatedRoom:
    return EmulatedRoom(space, SimpleNamespace(now=lambda: 0), (0.5, 0.3))


def test_posts_are_put_and_all_removed(space: Space, room: EmulatedRoom):
    room.command(["post", "3", "-1.5"])
    room.command(["post", "4", "0"])
    assert space.obstacles == [Disc(3.0, -1.5, RADIUS), Disc(4.0, 0.0, RADIUS)]
    room.command(["clear"])
    assert space.obstacles == []


@pytest.mark.parametrize(
    "words",
    [[], ["post"], ["post", "a", "1"], ["wall", "1", "2"], ["help"], ["post", "nan", "1"]],
)
def test_other_words_are_refused_with_those_that_are_known(room: EmulatedRoom, words: list[str]):
    with pytest.raises(InputError, match="room post X Y"):
        room.command(words)


@pytest.mark.parametrize("place", [("1.0", "2.0"), ("1.3", "2.0")])
def test_no_post_stands_in_the_robot(space: Space, room: EmulatedRoom, place: tuple[str, str]):
    with pytest.raises(InputError, match="the robot is there"):
        room.command(["post", *place])
    assert space.obstacles == []


def test_posts_are_bounded(space: Space, room: EmulatedRoom):
    for i in range(MOST_POSTS):
        room.command(["post", str(5 + i), "0"])
    with pytest.raises(InputError, match=f"{MOST_POSTS} posts"):
        room.command(["post", "9", "9"])
    assert len(space.obstacles) == MOST_POSTS
