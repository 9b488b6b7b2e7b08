"""Obstacles that a person puts into the world of an emulated robot while it runs."""

import math
from typing import Final

from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import InputError
from monstertruck_sim.world.obstacles import Box, Disc, penetration
from monstertruck_sim.world.world import World

WORDS: Final = "room post X Y (an upright post at a place of the world, m), room clear (remove all posts)"
MOST: Final = 50
"""Posts at one time: every one costs time in each scan."""


class EmulatedRoom:
    """Posts in a world, which the robot's sensors see and which stop it.

    Args:
        world: with the robot.
        clock: time.
        body: length and width of the robot, m.
    """

    def __init__(self, world: World, clock: Clock, body: tuple[float, float]) -> None:
        self._world, self._clock, self._body = world, clock, body
        self._posts: list[Disc] = []

    def command(self, words: list[str]) -> None:
        """Put a post or remove all.

        Raises:
            InputError: other words, a place where the robot stands, or too many posts.
        """
        now = self._clock.now()
        match words:
            case ["post", x, y]:
                try:
                    # Radius of a post, m.
                    post = Disc(float(x), float(y), 0.1)
                except ValueError:
                    raise InputError(f"expected {WORDS}") from None
                if not (math.isfinite(post.x) and math.isfinite(post.y)):
                    raise InputError(f"expected {WORDS}")
                self._put(now, post)
            case ["clear"]:
                while self._posts:
                    self._world.remove(now, self._posts.pop())
            case _:
                raise InputError(f"expected {WORDS}")

    def _put(self, now: int, post: Disc) -> None:
        if len(self._posts) >= MOST:
            raise InputError(f"{MOST} posts are in the room; remove them first")
        robot = self._world.truth(now)
        if penetration(Box(robot.x, robot.y, *self._body, robot.yaw), post) > 0:
            raise InputError(f"post at {post.x:.2f}, {post.y:.2f} m: the robot is there")
        self._world.add(now, post)
        self._posts.append(post)
