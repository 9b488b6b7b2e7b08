"""The truck's camera in three dimensions: rendered in software (EGL) in a thread, then distorted by the lens."""

import weakref
from concurrent.futures import ThreadPoolExecutor
from math import atan, tan

import numpy as np

from monstertruck_runtime.errors import InputError
from monstertruck_sim.world.camera import CameraPlace, Drawing, Painter, Picture, SimulatedView, mounted
from monstertruck_sim.world3d.model import Group
from monstertruck_sim.world3d.picture import CameraPose, WorldRenderer, standing
from monstertruck_sim.world3d.plant import RigidPlant


class RenderedView(SimulatedView):
    """``ViewSource`` for a rigid-body robot; ``SimulatedView`` provides all that is computed in the plane.

    Args:
        drawn: the equivalent camera in the plane.

    Raises:
        NotInstalledError: this computer has no EGL.
        InputError: the robot is not made of rigid bodies.
    """

    HIDDEN: tuple[Group, ...] = (Group.ROBOT,)
    """Groups omitted from its pictures: the robot that carries it."""

    def __init__(self, drawn: SimulatedView) -> None:
        self.__dict__.update(drawn.__dict__)
        if not isinstance(drawn.plant, RigidPlant):
            raise InputError("sim.world.camera.rendered: expected engine mujoco")
        self._rigid = drawn.plant
        self._thread = ThreadPoolExecutor(1, "camera")
        """An EGL context belongs to one thread."""
        self._renderers: dict[tuple[int, int], tuple[WorldRenderer, float, Painter]] = {}
        self._renderer((640, 480))  # size in pixels of the test image that shows whether this computer can render
        # At the program's end the thread, and with it the context, is already gone.
        weakref.finalize(self, _close, self._thread, self._renderers).atexit = False

    def exposure(self, time_ns: int, size: tuple[int, int]) -> Drawing:
        """Copy the world's state now, and render the image when the result is called."""
        self._rigid.advance(time_ns)
        renderer, wider, painter = self._renderer(size)
        place = self._place(time_ns)
        _, down, ahead = place.axes.tolist()
        width, height = size
        upright = 2 * atan(height / width * tan(self.config.field_of_view / 2) * wider)
        pose = CameraPose(tuple(place.centre.tolist()), tuple(ahead), (-down[0], -down[1], -down[2]), upright)
        crowd = self.crowd
        there = [] if crowd is None else standing(crowd.people_at(time_ns), self._rigid.ground)
        robots = () if crowd is None else crowd.robots_beside(self._rigid)
        renderer.arrange(self._rigid.data, pose, people=there, robots=robots, hidden=self.HIDDEN)
        sensor = self.sensor(time_ns)
        board = self.board_at(time_ns)

        def draw() -> Picture:
            picture = _bent(self._thread.submit(renderer.render).result(), wider, painter)
            if board is not None:
                painter.draw(picture, board, place, np.full(len(painter.azimuths), np.inf))
            return sensor(picture)

        return draw

    def _place(self, time_ns: int) -> CameraPlace:
        x, y, yaw, pitch, roll, z = self._rigid.poses(np.array([time_ns]))[:, 0].tolist()
        return mounted((x, y, yaw), self.config, (pitch, roll, z))

    def _renderer(self, size: tuple[int, int]) -> tuple[WorldRenderer, float, Painter]:
        if size not in self._renderers:
            renderer = self._thread.submit(WorldRenderer, self._rigid.model, *size).result()
            painter = self._painter(size)
            self._renderers[size] = renderer, painter.straight_pixels()[0], painter
        return self._renderers[size]


def _bent(picture: Picture, wider: float, painter: Painter) -> Picture:
    """Apply the lens distortion: each pixel is taken from its position in the undistorted picture."""
    if wider == 1.0:
        return picture
    import cv2  # noqa: PLC0415  # the library of an extra

    at = painter.straight_pixels()[1].astype(np.float32)
    bent: Picture = np.asarray(cv2.remap(picture, at, None, cv2.INTER_LINEAR), dtype=np.uint8)
    return bent


def _close(thread: ThreadPoolExecutor, renderers: dict[tuple[int, int], tuple[WorldRenderer, float, Painter]]) -> None:
    for renderer, *_ in renderers.values():
        thread.submit(renderer.close).result()
    thread.shutdown()
