"""The wizards of ``monstertruckd calibrate`` for the operator's page."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from monstertruck_runtime.errors import InputError
from monstertruckd.config.calibration_rpc import SHOW
from monstertruckd.config.wizards import WizardOption, WizardRun, sequence
from monstertruckd.station.calibration import Measured, PagePanel
from monstertruckd.tools.cli.calibrate import file_in, wizard_of
from monstertruckd.tools.cli.connection import robot_config

if TYPE_CHECKING:
    from monstertruck_runtime.client import TruckClient
    from monstertruck_runtime.clock import Clock
    from monstertruckd.config.calibration import Result


class PageCalibrator:
    """Offers and runs the steps of ``calibrate all``.

    Args:
        clock: clock of the station.
    """

    def __init__(self, clock: "Clock") -> None:
        self._clock = clock

    async def offered(self, truck: "TruckClient") -> list[dict[str, Any]]:
        """Return the steps that apply to the robot, in their order; steps never done are due."""
        from monstertruckd.tools.calibrate.wizard import missing

        config, known = await robot_config(truck), await _known(truck)
        due = set(map(_id, missing(config, known)))
        return [
            {
                "id": _id(run),
                "name": run.name,
                "rough": run.step.rough,
                "doc": _sentence(run.wizard.doc),
                "due": _id(run) in due,
                "options": [_option(option, run) for option in run.wizard.options],
            }
            for run in sequence()
            if run.wizard.fits(config) and run.step.fits(config)
        ]

    async def measure(self, truck: "TruckClient", step: str, options: Mapping[str, Any], panel: PagePanel) -> Measured:
        """Run a step.

        Raises:
            TruckError: the step or an option is unknown, or it ended without a result.
        """
        from monstertruckd.tools.calibrate.wizard import measure, save

        run = next((run for run in sequence() if _id(run) == step), None)
        if run is None:
            raise InputError(f"{step}: unknown calibration")
        given = {name: _checked(run, name, value) for name, value in options.items()}
        config, known = await robot_config(truck), await _known(truck)
        result = await measure(wizard_of(run, given), truck, panel, self._clock, config, known)

        async def saved() -> str:
            return (await save(truck, result))[1]

        return Measured(_rows(result, known.get(run.name)), result.measured, saved)


def _option(option: WizardOption, run: WizardRun) -> dict[str, Any]:
    """Describe an option for the page, with the default of this step."""
    default = run.step.options.get(option.name, option.default)
    return {
        "name": option.name,
        "default": default,
        "help": option.help,
        "low": option.low,
        "high": option.high,
        "choices": option.choices,
        "whole": type(option.default) is int,
    }


def _checked(run: WizardRun, name: str, value: float | bool | str) -> float | bool | str:
    """Parse the value of an option and check its type and bounds; the wizard checks choices.

    Raises:
        InputError: the option is unknown, or the value is invalid.
    """
    option = next((option for option in run.wizard.options if option.name == name), None)
    if option is None:
        names = ", ".join(option.name for option in run.wizard.options) or "none"
        raise InputError(f"{run.name}: option {name}: expected one of {names}")
    kind: type[Any] = type(option.default)
    mistake = InputError(f"{run.name}: option {name}: expected {kind.__name__}, got {value!r}")
    if kind is bool or kind is str:
        if type(value) is not kind:
            raise mistake
        return value
    if isinstance(value, bool | str) or (kind is int and not float(value).is_integer()):
        raise mistake
    low, high = (-math.inf if option.low is None else option.low), (math.inf if option.high is None else option.high)
    if not low <= value <= high:
        raise InputError(f"{run.name}: option {name}: expected {low:g} to {high:g}, got {value:g}")
    number: float = kind(value)
    return number


def _id(run: WizardRun) -> str:
    return f"{run.name}.{run.step.complete}"


def _sentence(doc: str) -> str:
    """Return the first paragraph in one line."""
    return " ".join(doc.partition("\n\n")[0].split())


async def _known(truck: "TruckClient") -> "dict[str, Result]":
    file = file_in(await truck.call(SHOW))
    return {} if file is None else dict(file.results)


def _rows(result: "Result", before: "Result | None") -> list[dict[str, Any]]:
    """Return the estimates, each with its previous value."""
    rows = []
    for estimate in result.estimates:
        old = None if before is None else before.estimate(estimate.name)
        row = estimate.model_dump(
            mode="json", include={"name", "unit", "meaning", "value", "low", "high", "grade", "samples"}
        )
        before_row = old and {"value": old.value, "low": old.low, "high": old.high}
        rows.append({**row, "before": before_row})
    return rows
