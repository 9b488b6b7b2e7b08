"""Workers compile their kernels when they are built, not at the first scan or goal that needs one."""

import subprocess
import sys

import pytest

from monstertruck_planners.goals import plan_step
from monstertruck_planners.goals.config import PlannerConfig
from monstertruck_planners.steps import PLANNING_BY_KIND
from monstertruck_runtime.plugins import kind_of

# In a process of its own: in this one other tests have compiled some.
SCRIPT = """
import importlib, pkgutil, sys
from numba.core.dispatcher import Dispatcher

module, worker, *packages = sys.argv[1:]
getattr(importlib.import_module(module), worker)()
for package in packages:
    for found in pkgutil.iter_modules(importlib.import_module(package).__path__, package + "."):
        importlib.import_module(found.name)
loaded = [module for name, module in sorted(sys.modules.items()) if name.startswith(tuple(packages))]
kernels = {value for module in loaded for value in vars(module).values() if isinstance(value, Dispatcher)}
functions = [kernel.py_func for kernel in kernels]
globals_used = [f.__globals__.get(name) for f in functions for name in f.__code__.co_names]
called_by_kernels = {used for used in globals_used if isinstance(used, Dispatcher)}
assert len(kernels) > 5
print(*sorted(k.py_func.__qualname__ for k in kernels - called_by_kernels if not k.signatures))
"""


@pytest.mark.parametrize(
    ("module", "worker", "package"),
    [
        ("monstertruck_estimation.slam.worker", "SlamWorker", "monstertruck_estimation.slam"),
        ("monstertruck_planners.goals.plan_step", "PlanningWorker", "monstertruck_planners.route"),
        ("monstertruck_planners.goals.deform_step", "DeformingWorker", "monstertruck_planners.local"),
    ],
)
def test_a_worker_has_compiled_all_its_kernels(module: str, worker: str, package: str):
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, module, worker, package], check=True, capture_output=True, text=True
    )
    assert not done.stdout.strip()


def test_the_planning_worker_of_a_robot_waits_for_its_own_planner_only(monkeypatch: pytest.MonkeyPatch):
    warmed: list[str] = []
    monkeypatch.setattr(plan_step, "warm_up", lambda planner: warmed.append(planner.config.kind))
    assert kind_of(type(PlannerConfig().route)) in PLANNING_BY_KIND
    for kind, target in PLANNING_BY_KIND.items():
        warmed.clear()
        getattr(plan_step, target.rpartition(":")[2])()
        assert warmed == [kind]
    plan_step.PlanningWorker()
    assert sorted(warmed[1:]) == ["grid_astar", "hybrid", "lattice"]
