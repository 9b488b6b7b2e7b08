"""A simulated stand with hidden cameras, and its calibration by the stand's own procedure."""

import cv2
import numpy as np

from monstertruck_estimation.vision.lens import Lens
from monstertruckd.tools.stand.calibration import StandCalibration, calibrate
from monstertruckd.tools.stand.camera import PlacedCamera
from monstertruckd.tools.stand.config import MarkConfig, OverheadConfig
from tests.stand_render import PictureQuality, StandRenderer, board_in_view, level_tag

GRID = ((-1.0, 0.75), (0.0, 0.75), (1.0, 0.75), (-1.0, -0.75), (0.0, -0.75), (1.0, -0.75))
"""Middles of six cameras' views over a table of 3 m x 3 m."""
HEIGHT = 2.2
LOOK = PictureQuality()


def hidden_camera(
    x: float, y: float, rng: np.random.Generator, grid: tuple[float, float] = (1.3, 1.75)
) -> PlacedCamera:
    """A camera over the table, about upright."""
    focal = 480 * HEIGHT / grid[1] * rng.uniform(0.98, 1.02)
    matrix = np.array(((focal, 0.0, 320 + rng.uniform(-8, 8)), (0.0, focal, 240 + rng.uniform(-8, 8)), (0.0, 0.0, 1.0)))
    distortion = np.array((rng.uniform(-0.25, -0.1), rng.uniform(0.0, 0.08), *rng.uniform(-1e-3, 1e-3, 2), 0.0))
    down = np.array(((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)))
    tilt, _ = cv2.Rodrigues(rng.uniform(-0.04, 0.04, 3))
    axes = tilt @ down
    centre = np.array((x + rng.uniform(-0.04, 0.04), y + rng.uniform(-0.04, 0.04), HEIGHT + rng.uniform(-0.05, 0.05)))
    return PlacedCamera(Lens(matrix, distortion, (640, 480)), np.ravel(cv2.Rodrigues(axes)[0]), -axes @ centre)


def turned(camera: PlacedCamera, axis: str, angle: float) -> PlacedCamera:
    """A camera that somebody has knocked: turned where it hangs.

    Args:
        camera: before.
        axis: its own one: "right", "down" or "ahead".
        angle: rad.
    """
    vector = np.zeros(3)
    vector[("right", "down", "ahead").index(axis)] = angle
    axes = cv2.Rodrigues(vector)[0] @ camera.axes
    return PlacedCamera(camera.lens, np.ravel(cv2.Rodrigues(axes)[0]), -axes @ camera.centre)


def marks() -> dict[int, tuple[float, float]]:
    """Tags on the table: a lattice of 0.5 m, as a person would lay them."""
    lattice = [(x, y) for y in (-1.4, -0.75, -0.05, 0.7, 1.4) for x in (-1.42, -0.95, -0.45, 0.05, 0.5, 0.95, 1.42)]
    return {100 + k: place for k, place in enumerate(lattice)}


def simulated(seed: int, cameras: int = 6, boards: int = 20, look: PictureQuality = LOOK, robots: int = 1):
    """Hidden cameras, the configuration that a person writes, and the calibration by the stand's procedure.

    Returns:
        true cameras, configuration, calibration, renderers, true places of the marks.
    """
    rng = np.random.default_rng(seed)
    hidden = {f"c{k + 1}": hidden_camera(*spot, rng) for k, spot in enumerate(GRID[:cameras])}
    true = {tag: (x, y, rng.uniform(-3, 3)) for tag, (x, y) in marks().items()}
    measured = {
        tag: MarkConfig(x=x + 0.0015 * rng.standard_normal(), y=y + 0.0015 * rng.standard_normal())
        for tag, (x, y, _) in true.items()
    }
    config = OverheadConfig.model_validate(
        {
            "version": 2,
            "cameras": {
                name: {
                    "source": {"kind": "file", "path": f"{name}/film"},
                    "boards": f"{name}/boards",
                    "floor": f"{name}/floor",
                }
                for name in hidden
            },
            "marks": {tag: mark.model_dump() for tag, mark in measured.items()},
            "robots": {f"r{k + 1}": {"tag": k, "height": 0.08} for k in range(robots)},
        },
        strict=False,
    )
    renderers = {name: StandRenderer(camera, look, seed + k) for k, (name, camera) in enumerate(hidden.items())}
    floor = [level_tag(tag, config.mark_size, x, y, yaw, 0.0) for tag, (x, y, yaw) in true.items()]
    boards = {
        name: [renderers[name].picture([board_in_view(config.board, camera, rng)]) for _ in range(boards)]
        for name, camera in hidden.items()
    }
    floors = {name: [renderers[name].picture(floor) for _ in range(3)] for name in hidden}
    found: StandCalibration = calibrate(config, boards, floors)
    return hidden, config, found, renderers, floor
