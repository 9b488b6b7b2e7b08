"""Exploring step: computes frontiers and the next viewpoint from map changes. For workers."""

import math

import numpy as np

from monstertruck_planners.collision import Footprint
from monstertruck_planners.explore.api import (
    LEAST_NEW_AREA,
    ExplorationView,
    Explorer,
    Option,
    Remembered,
    make_explorer,
)
from monstertruck_planners.explore.config import InformationConfig
from monstertruck_planners.explore.exchange import CameraView, ExploreAnswer, ExploreSetup, ExploreTask, Viewpoint
from monstertruck_planners.explore.frontier import FrontierMap
from monstertruck_planners.explore.look import WallLooks
from monstertruck_planners.zones.shapes import ZoneLayer, in_force
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.state import Grid


class ExploringStep:
    """Answers tasks in sequence; equal tasks give equal answers."""

    def __init__(self) -> None:
        self._setup: ExploreSetup | None = None
        self._explorer: Explorer | None = None
        self._map: FrontierMap | None = None
        self._layer = ZoneLayer()
        self._memory = Remembered()
        self._looks = WallLooks(CameraView())

    def step(self, task: ExploreTask) -> ExploreAnswer:
        """Carry out one task.

        Raises:
            InputError: the first task had no setup, or the map does not match the previous ones.
        """
        if task.setup is not None:
            self._setup, self._explorer = task.setup, make_explorer(task.setup.config)
            self._looks = WallLooks(task.setup.camera)
        if self._setup is None or self._explorer is None:
            raise InputError("exploring: expected a setup message first")
        if task.zones is not None:
            self._layer = ZoneLayer(in_force(task.zones), self._layer)
        self._take(task, self._setup.zone_margin)
        known = self._map
        if known is None:
            return ExploreAnswer()
        area = known.free * known.resolution**2
        if not task.choose:
            return ExploreAnswer(known=area)
        view = ExplorationView(known, self._setup, task.pose, task.banned, task.avoided, self._memory)
        target = self._explorer.choose(view, task.current, self._still(view, task.current), task.pursued)
        if task.find:
            self._looks.take(known, task.pose)
            target = target or self._looks.choose(view, task.current)
        return ExploreAnswer(
            target,
            kept=target is not None and target is task.current,
            frontiers=len(view.options),
            banned=view.left_alone,
            known=area,
            home=None if task.home is None else view.path_length_to(task.home[:2]),
        )

    def _take(self, task: ExploreTask, margin: float) -> None:
        for news, whole in (
            *(((task.whole, True),) if task.whole is not None else ()),
            *((t, False) for t in task.tiles),
        ):
            grid = zoned(news, self._layer, margin)
            if self._map is None:
                self._map = FrontierMap(grid)
            else:
                self._map.put(grid, whole=whole)

    @staticmethod
    def _still(view: ExplorationView, current: Viewpoint | None) -> Option | None:
        """Return the option that now corresponds to the current viewpoint; None if it would show little new area."""
        if current is None or float(view.gains(np.array([current.pose]))[0]) < max(LEAST_NEW_AREA, current.gain / 4):
            return None
        # 1.0: a frontier within this distance (m) of the current one is its successor
        near = [option for option in view.options if math.dist(option.frontier.middle, current.frontier) < 1.0]
        return min(near, key=lambda option: math.dist(option.frontier.middle, current.frontier), default=None)


def zoned(grid: Grid, layer: ZoneLayer, margin: float) -> Grid:
    """Return a grid with the cells of keepout zones occupied, so that no viewpoint, path or frontier lies there."""
    if not layer.shapes:
        return grid
    origin = (grid.origin.x, grid.origin.y, grid.origin.yaw)
    closed = layer.keepout_cells((grid.height, grid.width), grid.resolution, origin, margin)
    return grid.model_copy(update={"cells": np.where(closed.ravel(), np.int8(100), grid.cells)})


class ExploringWorker(ExploringStep):
    """Exploring step in a worker; compiles its code on construction."""

    def __init__(self) -> None:
        super().__init__()
        warm_up()


def warm_up() -> None:
    """Compile all code before the first decision is due."""
    cells = np.full((160, 160), -1, np.int8)
    cells[20:120, 20:120] = 0
    cells[20:120, [20, 119]] = cells[[20, 119], 20:120] = 100
    cells[60:80, 119] = cells[60:80, 20] = cells[20, 60:80] = cells[119, 60:80] = 0
    grid = Grid(
        stamp=0, received=0, seq=0, frame="map", resolution=0.05, width=160, height=160,
        origin=Pose2D(x=0.0, y=0.0, yaw=0.0), cells=cells.reshape(-1),
    )  # fmt: skip
    step = ExploringStep()
    pose = (3.5, 3.5, 0.0)
    setup = ExploreSetup(InformationConfig(), Footprint(), 0.5)
    first = step.step(ExploreTask(pose, grid, (), setup, choose=True, home=pose))
    assert first.target is not None
    step.step(ExploreTask(pose, choose=True, current=first.target))
