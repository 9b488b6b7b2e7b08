"""Ceiling cameras of a test stand in the three-dimensional world."""

from monstertruck_sim.config import CeilingCamera
from monstertruck_sim.world.board import BoardHolder
from monstertruck_sim.world.camera import CameraPlace, SimulatedView, mounted
from monstertruck_sim.world.config import HeldBoard
from monstertruck_sim.world.world import World
from monstertruck_sim.world3d.camera import RenderedView
from monstertruck_sim.world3d.model import Group


class CeilingView(RenderedView):
    """``ViewSource`` of a fixed camera in the world.

    Args:
        world: of engine mujoco.
        config: place, lens and noise.
        board: board held in front of the camera, or None.
        seed: seed of noise and board poses.

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
