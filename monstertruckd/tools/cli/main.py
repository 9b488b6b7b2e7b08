"""The ``monstertruckd`` command: mounts the command groups."""

import typer

from monstertruckd import __version__
from monstertruckd.tools.cli import (
    behave,
    calibrate,
    config,
    demo,
    description,
    devices,
    doctor,
    drill,
    goto,
    kinematics,
    live,
    logs,
    maps,
    mission,
    move,
    new,
    orders,
    plan,
    points,
    replay,
    robot,
    ros2,
    security,
    service,
    settings,
    stand,
    station,
    study,
    tune,
    usb,
    zones,
)
from monstertruckd.tools.cli.output import HELP_SETTINGS, HELP_STYLE, CommandGroup, Commands

app = Commands(
    name="monstertruckd",
    cls=CommandGroup,
    help="A daemon that controls all devices of a four-wheel-steered robot truck, drives it and records its data.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=HELP_STYLE,
    context_settings=HELP_SETTINGS,
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(__version__)
        raise typer.Exit


@app.callback()
def _options(
    version: bool = typer.Option(False, "--version", callback=_version, is_eager=True, help="Print the version."),
) -> None:
    pass


app.command("demo")(demo.demo)
app.command("try")(demo.try_out)
app.command("simulate")(demo.simulate)
app.command("drill")(drill.drill)
app.command("run")(robot.run)
app.command("new-driver")(new.new_driver)
app.command("new-robot", cls=new.AnswersCommand)(new.new_robot)
app.command("check-config", hidden=True)(config.show)  # its name before there were others
app.command("description")(description.description)
app.command("topics")(robot.topics)
app.command("reasons")(robot.reasons)
app.command("plugins")(robot.plugins)
app.command("status")(live.status)
app.command("echo")(live.echo)
app.command("drive")(orders.drive)
app.command("arm")(orders.arm)
app.command("disarm")(orders.disarm)
app.command("estop")(orders.estop)
app.command("reset")(orders.reset)
app.command("plan", context_settings={"ignore_unknown_options": True})(plan.plan)  # "-1,2,0" is a pose
app.command("goto", context_settings={"ignore_unknown_options": True})(goto.goto)
app.command("track")(goto.track)
app.command("path")(goto.path)
app.command("convert-path")(goto.convert_path)
app.command("convert-lens")(config.convert_lens)
app.command("import-urdf")(description.import_urdf)
app.command("move", cls=move.MoveCommand)(move.move)
app.command("get")(settings.get)
app.command("set", context_settings={"ignore_unknown_options": True})(settings.set_value)
app.command("explore", cls=goto.ExploreCommand)(goto.explore)
app.command("plan-server")(robot.plan_server)
app.command("replay")(replay.replay)
app.command("emulate")(devices.emulate)
app.command("probe")(devices.probe)
app.command("usb")(usb.usb)
app.command("find-port")(usb.find_port)
app.command("station")(station.station)
app.command("ros2")(ros2.ros2)
app.command("doctor")(doctor.doctor)
app.command("install-service")(service.install_service)
app.command("uninstall-service")(service.uninstall_service)
app.command("dock", cls=goto.DockCommand)(goto.dock)
app.command("undock", cls=goto.DockCommand)(goto.undock)
app.add_typer(behave.app, name="behave")
app.add_typer(mission.app, name="mission")
app.add_typer(config.app, name="config")
app.add_typer(calibrate.app, name="calibrate")
app.add_typer(logs.app, name="log")
app.add_typer(kinematics.app, name="kinematics")
app.add_typer(study.app, name="study")
app.add_typer(tune.app, name="tune")
app.add_typer(stand.app, name="stand")
app.add_typer(maps.app, name="map")
app.add_typer(points.app, name="points")
app.add_typer(zones.app, name="zone")
app.add_typer(security.app, name="security")


def main() -> None:
    """Run the command line."""
    app()


if __name__ == "__main__":
    main()
