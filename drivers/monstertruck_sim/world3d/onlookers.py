"""Cameras in the world that are not on a robot: one that films a robot, and a stand's ceiling cameras."""

from math import cos, sin
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from PIL import Image

from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import InputError, TruckError
from monstertruck_runtime.moving_picture import MovingPicture
from monstertruck_sim.config import CeilingCamera
from monstertruck_sim.world.board import BoardHolder
from monstertruck_sim.world.camera import CameraPlace, SimulatedView, mounted
from monstertruck_sim.world.config import HeldBoard
from monstertruck_sim.world.world import World
from monstertruck_sim.world3d.camera import RenderedView
from monstertruck_sim.world3d.model import Group
from monstertruck_sim.world3d.picture import WorldRenderer, looking_at, standing
from monstertruck_sim.world3d.plant import RigidPlant

FRAME_RATE: Final = 8
"""Frame rate (Hz)."""
_BEHIND, _ASIDE, _ABOVE = 1.25, 0.7, 0.95
"""Position of the camera relative to the robot (m); it swings around to stay behind a turning robot."""
_PLAIN: Final = Image.Dither.NONE


class Film:
    """Film of one robot; use it only on a virtual clock's loop, because a frame takes tens of milliseconds.

    Use it as a context manager. The film is kept if the run ends with a robot error; an interrupted run leaves no file.

    Args:
        world: world with the robot.
        clock: world clock.
        file: GIF file, written during the run and renamed at its end.

    Raises:
        InputError: the engine cannot render, or the file is not a GIF.
        NotInstalledError: this computer has no EGL.
    """

    def __init__(self, world: World, clock: Clock, file: Path) -> None:
        if file.suffix.lower() != ".gif":
            raise InputError(f"{file}: expected a name that ends with .gif")
        if not isinstance(world.plant, RigidPlant):
            raise InputError(f"{file}: recording needs sim.world.engine mujoco")
        self._world, self._clock, self._plant = world, clock, world.plant
        self._renderer = WorldRenderer(world.plant.model, 480, 320)
        self._heading = world.plant.pose[2]
        self._pictures = MovingPicture(file, 1 / FRAME_RATE)

    async def run(self) -> None:
        """Record frames until cancelled.

        Raises:
            OSError: the file cannot be written.
        """
        due = self._clock.now()
        while True:
            self.take()
            due += SECOND // FRAME_RATE
            await self._clock.sleep_until(due)

    def take(self) -> None:
        """Record one frame immediately."""
        now = self._clock.now()
        self._world.truth(now)
        x, y, yaw = self._plant.pose
        z = self._plant.height
        self._heading += 0.12 * (yaw - self._heading)  # fraction of the remaining angle covered from frame to frame
        c, s = cos(self._heading), sin(self._heading)
        camera = x - _BEHIND * c + _ASIDE * s, y - _BEHIND * s - _ASIDE * c, z + _ABOVE
        view = looking_at(camera, (x + 0.3 * c, y + 0.3 * s, z + 0.1))
        people = standing(self._world.scene.people_at(now), self._plant.ground)
        robots = self._world.scene.robots_beside(self._plant)
        picture = self._renderer.draw(self._plant.data, view, people=people, robots=robots)
        self._pictures.add(Image.fromarray(picture).quantize(128, Image.Quantize.MAXCOVERAGE, dither=_PLAIN))  # colours

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._renderer.close()
        if isinstance(error, TruckError):
            self._pictures.close()
        else:
            self._pictures.__exit__(kind, error, trace)


class CeilingView(RenderedView):
    """``ViewSource`` for a fixed camera in the world.

    Args:
        world: world with the mujoco engine.
        config: pose, lens and noise.
        board: board held in front of the camera, or None.
        seed: seed for noise and board poses.

    Raises:
        NotInstalledError: this computer has no EGL.
        InputError: the world has no renderer.
    """

    HIDDEN: tuple[Group, ...] = ()

    def __init__(self, world: World, config: CeilingCamera, board: HeldBoard | None, seed: int) -> None:
        holder = None if board is None else BoardHolder(board, config.field_of_view, seed)
        drawn = SimulatedView(world.plant, world.scene.cast, config, crowd=world.scene, holder=holder, seed=seed)
        super().__init__(drawn)

    def _place(self, _time_ns: int) -> CameraPlace:
        return mounted((0.0, 0.0, 0.0), self.config)
