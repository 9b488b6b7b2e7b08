"""Cameras under the ceiling of the world in three dimensions: what a test stand sees from above."""

from monstertruck_sim.config import CeilingCamera
from monstertruck_sim.world.board import BoardHolder
from monstertruck_sim.world.camera import CameraPlace, SimulatedView, mounted
from monstertruck_sim.world.config import HeldBoard
from monstertruck_sim.world.world import World
from monstertruck_sim.world3d.camera import RenderedView
from monstertruck_sim.world3d.model import Group


class CeilingView(RenderedView):
    """``ViewSource`` of a camera that hangs in the world.

    Args:
        world: of engine mujoco.
        config: place, lens and noise.
        board: somebody holds it before the camera; None = nobody does.
        seed: of noise and board.

    Raises:
        NotInstalledError: this computer has no EGL.
        InputError: the world has nothing to render.
    """

    HIDDEN: tuple[Group, ...] = ()

    def __init__(self, world: World, config: CeilingCamera, board: HeldBoard | None, seed: int) -> None:
        holder = None if board is None else BoardHolder(board, config.field_of_view, seed)
        drawn = SimulatedView(world.plant, world.scene.cast, config, crowd=world.scene, holder=holder, seed=seed)
        super().__init__(drawn)

    def _place(self, _time_ns: int) -> CameraPlace:
        return mounted((0.0, 0.0, 0.0), self.config)
