"""``monstertruckd tune``: gains found by runs of the robot."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT
from monstertruck_runtime.errors import InputError, NotFoundError
from monstertruck_runtime.extras import needs_extra
from monstertruckd.tools.cli.connection import require_section, with_robot
from monstertruckd.tools.cli.model_options import ModelCommand, field_parameters
from monstertruckd.tools.cli.options import EndpointOption, RobotOption
from monstertruckd.tools.cli.output import command_group, print_table, remark

if TYPE_CHECKING:
    import inspect
    from collections.abc import Iterator

    from monstertruck_runtime.client import TruckClient
    from monstertruck_runtime.clock import Clock
    from monstertruckd.tools.tune.recipe import WallGains
    from monstertruckd.tools.tune.runs import TuningRun

app = command_group("Find controller gains with test runs of the robot.")


class WallCommand(ModelCommand):
    """Command with the settings of the runs as options."""

    def added(self) -> "Iterator[inspect.Parameter]":
        """Yield the settings."""
        from monstertruckd.tools.tune.runs import Tuning

        return field_parameters(Tuning, *Tuning.model_fields, defaults=True)


@app.command("wall", cls=WallCommand)
def wall_command(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="A behaviour of kind wall_pd.")] = "wall_left",
    plot: Annotated[
        Path | None, typer.Option("--plot", help="PNG file with the figure of all runs.", show_default=False)
    ] = None,
    robot: RobotOption = "sonar",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
) -> None:
    """Arm the robot, which stands next to a wall, and raise K_p and K_d by the coursework's recipe, run by run."""
    from monstertruckd.tools.tune.runs import Tuning, tune

    tuning = Tuning.model_validate(context.obj)
    if plot is not None:
        with needs_extra("plot"):
            from monstertruckd.tools.figures import require_drawable

            require_drawable(plot)
    runs: list[TuningRun] = []

    def report(run: "TuningRun") -> None:
        runs.append(run)
        remark(run.text)

    async def main(client: "TruckClient", clock: "Clock") -> "WallGains | None":
        config = (await require_section(client, "behaviours", "has no behaviours")).get(name)
        if config is None:
            raise NotFoundError(f"no behaviour {name!r}: see `monstertruckd behave list`")
        if config["kind"] != "wall_pd":
            raise InputError(f"{name} is of kind {config['kind']}: expected wall_pd, which has these gains")
        return await tune(client, name, float(config["distance"]), tuning, lambda: clock.sleep(1.5), report)

    try:
        best = with_robot(main, robot, endpoint)
    finally:
        if plot is not None and runs:
            from monstertruckd.tools.tune.runs import draw

            draw(runs, plot)
            remark(f"wrote {plot}")
    if best is None:
        raise NotFoundError(
            "no gains gave a calm run: noise of the sonars or a lag causes oscillation; try another --first"
        )
    print_table(("k_p", "k_d"), [(f"{best.k_p:.3g}", f"{best.k_d:.3g}")], right=("k_p", "k_d"))
