"""Kernels compiled ahead of their first use."""

import sys
from types import ModuleType

import pytest

from monstertruck_sim.world import camera
from monstertruckd.tools.install import kernels


def test_every_worker_whose_packages_are_installed_is_built(monkeypatch: pytest.MonkeyPatch):
    built: list[str] = []
    present = ModuleType("present_worker")
    present.build = lambda: built.append("present")  # type: ignore[attr-defined]

    def incomplete() -> None:
        import no_such_package  # noqa: F401

    present.incomplete = incomplete  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "present_worker", present)
    workers = ("no_such_package:Worker", "present_worker:incomplete", "present_worker:build")
    monkeypatch.setattr(kernels, "WORKERS", workers)
    monkeypatch.setattr(camera, "compile_kernels", lambda: built.append("camera"))
    said: list[str] = []
    kernels.compile_kernels(said.append)
    assert built == ["present", "camera"]
    assert said[2] == "  3 of 4: present_worker"


def test_mapping_planning_deformation_tracking_and_exploration_are_among_them():
    assert [target.partition(":")[2] for target in kernels.WORKERS] == [
        "SlamWorker",
        "PlanningWorker",
        "DeformingWorker",
        "TrackingWorker",
        "ExploringWorker",
    ]
