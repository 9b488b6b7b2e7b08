"""Images of the world, rendered in software without a screen (EGL)."""

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from monstertruck_runtime.errors import NotInstalledError
from monstertruck_sim.world.plant import Plant
from monstertruck_sim.world3d.model import Group
from monstertruck_sim.world3d.plant import RigidPlant

Somebody = tuple[float, float, float, float]
"""A person: x, y, height of the ground, and radius (m)."""
Picture = NDArray[np.uint8]
"""Image of shape (height, width, 3): red, green, blue; the top row first."""


@dataclass(frozen=True, slots=True)
class CameraPose:
    """Camera pose for an image.

    Args:
        place: camera position (m).
        ahead: unit vector along the optical axis.
        up: unit vector perpendicular to ``ahead``.
        field_of_view: vertical angle of view (rad).
    """

    place: tuple[float, float, float]
    ahead: tuple[float, float, float]
    up: tuple[float, float, float]
    field_of_view: float = 1.0


def looking_at(
    place: tuple[float, float, float], at: tuple[float, float, float], field_of_view: float = 1.0
) -> CameraPose:
    """Return the pose of an upright camera aimed at a point."""
    ahead = np.subtract(at, place) / np.linalg.norm(np.subtract(at, place))
    left = np.cross((0.0, 0.0, 1.0), ahead)
    left /= np.linalg.norm(left)
    up = np.cross(ahead, left)
    return CameraPose(place, _triple(ahead), _triple(up), field_of_view)


def standing(people: Iterable[tuple[float, float, float]], ground: Callable[[float, float], float]) -> list[Somebody]:
    """Return people (x, y and radius, m) with the height of the ground below them (m)."""
    return [(x, y, ground(x, y), radius) for x, y, radius in people]


class WorldRenderer:
    """Renders a model; use it in a single thread.

    Args:
        model: MuJoCo model.
        width: image width (pixels).
        height: image height (pixels).

    Raises:
        NotInstalledError: this computer has no EGL.
    """

    def __init__(self, model: mujoco.MjModel, width: int = 640, height: int = 480) -> None:
        try:
            from mujoco.egl import GLContext  # noqa: PLC0415  # raises where there is no EGL
        except (ImportError, AttributeError) as error:
            raise NotInstalledError(
                f"images: no EGL on this computer (Debian: apt install libegl1): {error}"
            ) from error
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        self._model = model
        try:
            self._gl = GLContext(width, height)
        except RuntimeError as error:
            raise NotInstalledError(f"images: EGL cannot render (Debian: apt install libegl-mesa0): {error}") from error
        self._gl.make_current()
        self._scene = mujoco.MjvScene(model, maxgeom=5000)
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._view = mujoco.MjrRect(0, 0, width, height)
        self._option = mujoco.MjvOption()
        self._pixels = np.empty((height, width, 3), np.uint8)

    def draw(
        self,
        data: mujoco.MjData,
        camera_pose: CameraPose,
        *,
        people: Sequence[Somebody] = (),
        robots: Sequence[Plant] = (),
    ) -> Picture:
        """Draw the world in the state given by ``data``, with people and other robots."""
        self.arrange(data, camera_pose, people=people, robots=robots)
        return self.render()

    def arrange(
        self,
        data: mujoco.MjData,
        camera_pose: CameraPose,
        *,
        people: Sequence[Somebody] = (),
        robots: Sequence[Plant] = (),
        hidden: Collection[Group] = (),
    ) -> None:
        """Update the scene to draw; may run in any thread.

        Args:
            data: world state.
            camera_pose: camera pose.
            people: people in the world.
            robots: robots other than the model's; rigid-body robots are drawn with their pose and steering.
            hidden: geometry groups to omit.
        """
        self._option.geomgroup[:] = [group in list(Group) and group not in hidden for group in range(mujoco.mjNGROUP)]
        camera = mujoco.MjvCamera()
        mujoco.mjv_updateScene(
            self._model, data, self._option, None, camera, mujoco.mjtCatBit.mjCAT_ALL.value, self._scene
        )
        # Hills receive shadows but cast none: they are drawn twice instead of three times, as their slopes are gentle.
        for geom in self._scene.geoms[: self._scene.ngeom]:
            if geom.type == mujoco.mjtGeom.mjGEOM_HFIELD:
                geom.category = mujoco.mjtCatBit.mjCAT_DECOR
                break
        for somebody in people:
            self._add_person(*somebody)
        for robot in robots:
            if isinstance(robot, RigidPlant):
                self._add_robot(robot)
        near = 0.01
        half = near * np.tan(camera_pose.field_of_view / 2)
        for part in self._scene.camera:
            part.pos[:], part.forward[:], part.up[:] = camera_pose.place, camera_pose.ahead, camera_pose.up
            part.frustum_near, part.frustum_far = near, 100.0
            part.frustum_bottom, part.frustum_top = -half, half
            part.frustum_center, part.frustum_width = 0.0, half * self._view.width / self._view.height
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = True

    def render(self) -> Picture:
        """Render the scene; must run in the thread that created the renderer."""
        self._gl.make_current()
        mujoco.mjr_render(self._view, self._scene, self._context)
        mujoco.mjr_readPixels(self._pixels, None, self._view, self._context)
        return self._pixels[::-1].copy()

    def _add_person(self, x: float, y: float, z: float, radius: float) -> None:
        """Add a person's legs, trunk and head at a position."""
        parts = (
            (mujoco.mjtGeom.mjGEOM_CYLINDER, (0.8 * radius, 0.4, 0.0), 0.4, (0.2, 0.24, 0.36, 1.0)),
            (mujoco.mjtGeom.mjGEOM_CYLINDER, (radius, 0.32, 0.0), 1.12, (0.6, 0.24, 0.2, 1.0)),
            (mujoco.mjtGeom.mjGEOM_SPHERE, (0.12, 0.0, 0.0), 1.57, (0.8, 0.63, 0.5, 1.0)),
        )
        for kind, size, middle, colour in parts:
            self._add(kind, np.array(size), np.array((x, y, z + middle)), np.eye(3).ravel(), np.array(colour))

    def _add_robot(self, robot: RigidPlant) -> None:
        """Add the robot's visible geometries at their poses."""
        model, data = robot.model, robot.data
        for geom in np.flatnonzero((model.geom_group == Group.ROBOT) & (model.geom_rgba[:, 3] > 0.0)):
            look = model.geom_type[geom], model.geom_size[geom], data.geom_xpos[geom], data.geom_xmat[geom]
            self._add(*look, model.geom_rgba[geom])

    def _add(
        self, kind: int, size: NDArray[Any], place: NDArray[Any], axes: NDArray[Any], colour: NDArray[Any]
    ) -> None:
        if self._scene.ngeom < self._scene.maxgeom:
            geom = self._scene.geoms[self._scene.ngeom]
            mujoco.mjv_initGeom(geom, kind, size, place, axes, colour.astype(np.float32))
            self._scene.ngeom += 1

    def close(self) -> None:
        """Release the EGL context."""
        self._context.free()
        self._gl.free()


def _triple(vector: NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, z = vector.tolist()
    return x, y, z
