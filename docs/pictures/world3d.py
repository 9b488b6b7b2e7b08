"""Draws the pictures of the worlds of ``configs/world3d``: run it without arguments."""

from pathlib import Path

from PIL import Image

from monstertruck_sim.world.world import World
from monstertruck_sim.world3d.picture import WorldRenderer, looking
from monstertruck_sim.world3d.plant import RigidPlant
from monstertruckd.tools.shipped import shipped
from monstertruckd.tools.simulation.config import load_simulated

PICTURES = Path(__file__).resolve().parent / "world3d"
SIZE = (560, 340)


def main() -> None:
    """One picture of each."""
    PICTURES.mkdir(exist_ok=True)
    for file in sorted(shipped("configs/world3d").glob("*.yaml")):
        config = load_simulated(file).sim
        world = World(config.world, config.seed)
        world.truth(0)
        plant = world.plant
        assert isinstance(plant, RigidPlant)
        middle = (5.0, 4.0, 0.0) if config.world.map == "rooms" else (4.0, 0.0, 0.2)
        renderer = WorldRenderer(plant.model, *SIZE)
        picture = renderer.draw(plant.data, looking((middle[0] - 4.5, middle[1] - 6.0, 5.5), middle))
        renderer.close()
        Image.fromarray(picture).quantize(96).save(PICTURES / f"{file.stem}.png", optimize=True)


if __name__ == "__main__":
    main()
