"""What the size of the house is counted by."""

import tomllib
from pathlib import Path

from benchmarks.house import REST, module_of

ROOT = Path(__file__).parents[3]


def test_what_counts_as_rest_is_what_the_core_may_not_import():
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    (contract,) = (one for one in contracts if one["name"] == "Core never imports the rest")
    rest = {module_of(path) for path in REST if not path.startswith("monstertruckd/tools/cli/")}
    forbidden = {name.removesuffix(".driver") for name in contract["forbidden_modules"]}
    assert rest == forbidden - {"monstertruckd.tools.cli"}
