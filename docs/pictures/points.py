"""What the truck's camera sees, in the plane and in 3D, and a camera above it: ``python docs/pictures/points.py``."""

import math
from pathlib import Path

from PIL import Image

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Pose2D
from monstertruck_sim.world.config import CameraConfig, PersonConfig, Spot, TagConfig, WorldConfig
from monstertruck_sim.world.world import World
from monstertruck_sim.world3d.onlookers import CeilingView
from monstertruckd.tools.simulation.config import load_simulated

FOLDER = Path(__file__).parent
TAGS = (
    TagConfig(tag=2, x=0.305, y=2.2, z=0.25, yaw=0.0),
    TagConfig(tag=8, x=0.305, y=1.5, z=0.3, yaw=0.0),
    TagConfig(tag=4, x=1.6, y=2.995, z=0.25, yaw=-math.pi / 2),
)
SOMEBODY = PersonConfig(waypoints=(Spot(x=0.9, y=1.1), Spot(x=0.9, y=1.2)), pause=1000.0)


def main() -> None:
    """Draw them."""
    for name, engine in (("plane", "plane"), ("3d", "mujoco")):
        camera = CameraConfig(noise=3.0, k1=-0.12, rendered=engine == "mujoco")
        start = Pose2D(x=2.9, y=1.9, yaw=math.pi)
        config = WorldConfig(map="rooms", engine=engine, start=start, tags=TAGS, people=(SOMEBODY,), camera=camera)
        picture = World(config, 1).view.exposure(SECOND, (640, 480))()
        Image.fromarray(picture).save(FOLDER / f"points-{name}.png", optimize=True)
    sim = load_simulated(FOLDER.parents[1] / "configs" / "world3d" / "stand.yaml").sim
    world = World(sim.world, sim.seed)
    picture = CeilingView(world, sim.stand.cameras["c1"], None, sim.seed).exposure(SECOND, (640, 480))()
    Image.fromarray(picture).save(FOLDER / "points-ceiling.png", optimize=True)


if __name__ == "__main__":
    main()
