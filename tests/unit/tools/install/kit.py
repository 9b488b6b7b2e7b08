"""What the tests of the installation share."""

from pathlib import Path

from monstertruckd.tools.install.files import Program
from monstertruckd.tools.install.plan import InstallPlan, plan

ROOT = Path(__file__).resolve().parents[4]
TRUCK = ROOT / "configs" / "truck.yaml"
PROGRAM = Program(
    Path("/opt/monstertruckd/.venv/bin/python"), Path("/opt/monstertruckd/systemd/neutral.py"), (Path("/opt"),)
)


def truck_plan(
    root: Path, config: Path | None = TRUCK, program: Program = PROGRAM, user: str | None = None
) -> InstallPlan:
    return plan(config, user, program, root)


def text_of(planned: InstallPlan, name: str) -> str:
    return next(file.text for file in planned.files if file.path.name == name and file.target is None)


def settings(unit: str) -> dict[str, list[str]]:
    """Values of a unit by key, in their order."""
    values: dict[str, list[str]] = {}
    for line in unit.splitlines():
        if "=" in line and not line.startswith("#"):
            key, _, value = line.partition("=")
            values.setdefault(key, []).append(value)
    return values
