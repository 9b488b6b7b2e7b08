"""Scans become a raster, rasters and paths become a picture; all of it in a worker process."""

import io

import numpy as np
import pytest
from PIL import Image

from monstertruck_runtime.actors.actor import WorkerActor
from monstertruck_runtime.clock import WallClock
from monstertruck_runtime.errors import WorkerError
from monstertruckd.recorder.occupancy import OccupancyRaster
from monstertruckd.recorder.picture_worker import STYLES, MapRenderer


def cell_at(raster: OccupancyRaster, x: float, y: float) -> float:
    area = raster.area
    row, column = int((y - area.y0) / raster.cell), int((x - area.x0) / raster.cell)
    return float(raster.occupancy()[row, column])


def test_beams_clear_what_they_cross_and_mark_where_they_end():
    raster = OccupancyRaster(0.1)
    raster.add(np.array([0.05, 0.05]), np.array([[2.05, 0.05], [0.05, -1.45], [np.nan, 1.0], [np.inf, 0.0]]))
    assert cell_at(raster, 2.05, 0.05) == 1.0
    assert cell_at(raster, 0.05, -1.45) == 1.0
    assert [cell_at(raster, 0.1 * i + 0.05, 0.05) for i in range(20)] == [0.0] * 20
    assert np.isnan(cell_at(raster, 2.25, 0.05))
    assert np.isnan(cell_at(raster, 1.05, 0.55))


def test_counts_stay_in_place_while_the_raster_grows():
    raster = OccupancyRaster(0.1)
    origin = np.array([0.05, 0.05])
    raster.add(origin, np.array([[1.05, 0.05]]))
    raster.add(origin, np.array([[-30.05, -20.05], [1.55, 0.05]]))
    raster.add(origin, np.array([[40.05, 35.05]]))
    assert cell_at(raster, 1.05, 0.05) == 0.5
    assert cell_at(raster, 1.55, 0.05) == 1.0
    assert cell_at(raster, -30.05, -20.05) == 1.0
    assert cell_at(raster, 40.05, 35.05) == 1.0


def test_an_empty_scan_changes_nothing():
    raster = OccupancyRaster()
    raster.add(np.zeros(2), np.full((3, 2), np.nan))
    assert raster.occupancy().size == 0


def room(renderer: MapRenderer) -> None:
    """A square room of 4 m around the origin, seen from its middle with the truck turned."""
    angles = np.linspace(0, 2 * np.pi, 2000)
    ranges = 2.0 / np.maximum(np.abs(np.cos(angles)), np.abs(np.sin(angles)))
    yaw = 0.7
    points = np.stack([ranges * np.cos(angles - yaw), ranges * np.sin(angles - yaw)], axis=1)
    assert renderer.step({"scans": [((0.0, 0.0, yaw), points)] * 2}) == {"scans": 2}


def picture(outputs: dict[str, bytes]) -> Image.Image:
    image = Image.open(io.BytesIO(outputs["png"]))
    image.load()
    return image.convert("RGB")


def has_color(image: Image.Image, color: str) -> bool:
    wanted = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)])
    return bool((np.abs(np.asarray(image, dtype=int) - wanted).max(axis=2) <= 2).any())


def test_the_picture_shows_walls_free_space_and_every_path():
    renderer = MapRenderer()
    room(renderer)
    poses = [[-1.5, -1.5, 0.0], [1.5, -1.5, 0.0], [1.5, 1.5, 1.57]]
    paths = [
        {"name": style, "style": style, "poses": np.array(poses) + 0.2 * number} for number, style in enumerate(STYLES)
    ]
    image = picture(renderer.step({"render": {"title": "room", "subtitle": "a test", "paths": paths}}))
    for style in STYLES.values():
        assert has_color(image, style.color)
    assert has_color(image, "#222b36")  # walls
    assert has_color(image, "#fafbfc")  # free
    assert has_color(image, "#d8dde3")  # unknown
    bare = picture(renderer.step({"render": {"title": "room"}}))
    assert not any(has_color(bare, style.color) for style in STYLES.values())


def test_walls_are_drawn_where_they_are():
    renderer = MapRenderer()
    room(renderer)
    image = picture(renderer.step({"render": {"title": ""}}))
    dark = np.argwhere(np.asarray(image.convert("L"))[84:-64] < 70)
    (top, left), (bottom, right) = dark.min(axis=0), dark.max(axis=0)
    assert bottom - top == pytest.approx(right - left, abs=4)
    assert right - left == pytest.approx(4.05 / 4.85 * 1200, rel=0.02)


def test_nothing_seen_and_nothing_driven_is_still_a_picture():
    image = picture(MapRenderer().step({"render": {"title": "empty", "paths": [
        {"name": "planned", "style": "planned", "poses": []},
        {"name": "point", "style": "driven", "poses": [[0.0, 0.0]]},
    ]}}))  # fmt: skip
    assert min(image.size) > 600


def test_narrow_maps_leave_room_for_the_texts():
    poses = [[0.0, 0.0], [0.0, 30.0]]
    image = picture(MapRenderer().step({"render": {"title": "shaft", "paths": [
        {"name": "planned", "style": "planned", "poses": poses},
    ]}}))  # fmt: skip
    assert image.size[0] >= 640
    assert image.size[1] > 1200


async def test_in_its_worker_process():
    worker = WorkerActor(
        "map", "monstertruckd.recorder.picture_worker:MapRenderer", WallClock(), latency=0.05, deadline=20.0
    )
    async with worker:
        points = np.array([[1.0, 0.0], [0.0, 1.0]])
        assert await worker.step({"scans": [((0.0, 0.0, 0.0), points)]}) == {"scans": 1}
        image = picture(await worker.step({"render": {"title": "worker"}}))
        assert has_color(image, "#222b36")
        with pytest.raises(WorkerError, match="KeyError: 'pink'"):
            await worker.step({"render": {"title": "", "paths": [{"name": "", "style": "pink", "poses": []}]}})
