"""Draws the pictures of the worlds of ``configs/world3d``: run it without arguments."""

from pathlib import Path
from typing import Final, NamedTuple

from PIL import Image

from monstertruck_sim.world.world import World, make_scene
from monstertruck_sim.world3d.picture import WorldRenderer, looking_at, standing
from monstertruck_sim.world3d.plant import RigidPlant
from monstertruckd.tools.shipped import shipped
from monstertruckd.tools.simulation.config import load_simulated

PICTURES = Path(__file__).resolve().parent / "world3d"
SIZE = (560, 340)
COLOURS: Final = 200
SETTLED: Final = 100_000_000
"""Time of the picture, ns: everybody is where he stands."""


class View(NamedTuple):
    """What is looked at, and from where beside it; m."""

    at: tuple[float, float, float] = (4.0, 0.0, 0.2)
    aside: tuple[float, float, float] = (-4.5, -6.0, 5.3)


ROOMS = View((5.0, 4.0, 0.0), (-4.5, -6.0, 5.5))
VIEWS: Final = {
    "rooms": ROOMS,
    "house": ROOMS,
    "stand": View((0.0, 0.0, 0.0), (-1.2, -1.9, 1.9)),
    "leader": View((0.0, 0.0, 0.2), (-2.6, -3.6, 3.1)),
}
WITH: Final = {"leader": ("second",)}
"""Robots that share a picture with the one that it is named after."""


def main() -> None:
    """One picture of each."""
    PICTURES.mkdir(exist_ok=True)
    files = {file.stem: file for file in shipped("configs/world3d").glob("*.yaml")}
    for name in sorted(files.keys() - {other for others in WITH.values() for other in others}):
        configs = [load_simulated(files[each]).sim for each in (name, *WITH.get(name, ()))]
        seed = configs[0].seed
        scene = make_scene(configs[0].world, seed, [config.world for config in configs[1:]])
        worlds = [World(config.world, seed, scene, f"robot_{i}") for i, config in enumerate(configs)]
        for world in worlds:
            world.truth(SETTLED)
        plant = worlds[0].plant
        assert isinstance(plant, RigidPlant)
        plant.before_steps()
        worlds[0].truth(2 * SETTLED)
        view = VIEWS.get(name, View())
        eye = tuple(a + b for a, b in zip(view.at, view.aside, strict=True))
        renderer = WorldRenderer(plant.model, *SIZE)
        people = standing(scene.people_at(2 * SETTLED), plant.ground)
        robots = scene.robots_beside(plant)
        picture = renderer.draw(plant.data, looking_at((eye[0], eye[1], eye[2]), view.at), people=people, robots=robots)
        renderer.close()
        image = Image.fromarray(picture).quantize(COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
        image.save(PICTURES / f"{name}.png", optimize=True)


if __name__ == "__main__":
    main()
