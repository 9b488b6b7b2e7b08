"""``monstertruckd ros2``: the robot as a ROS 2 node."""

from enum import StrEnum
from typing import TYPE_CHECKING, Annotated

import typer

from monstertruck_runtime.endpoints import is_endpoint
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.extras import needs_extra
from monstertruckd.tools.cli.output import remark, until_stopped

if TYPE_CHECKING:
    from contextlib import AbstractAsyncContextManager

    from monstertruck_runtime.clock import WallClock
    from monstertruckd.config.truck import TruckConfig
    from monstertruckd.ros2.facts import RobotFacts
    from monstertruckd.ros2.node import RosNode


class Face(StrEnum):
    """How ROS 2 is spoken to."""

    ZENOH = "zenoh"
    RCLPY = "rclpy"


class Distribution(StrEnum):
    """ROS 2 distributions by their type hashes."""

    JAZZY = "jazzy"
    KILTED = "kilted"
    LYRICAL = "lyrical"
    HUMBLE = "humble"


def ros2(
    robot: Annotated[
        str | None,
        typer.Option(
            "--robot", "-r", metavar="NAME@ENDPOINT", help="Name of the robot. Default: the robot of this computer."
        ),
    ] = None,
    face: Annotated[
        Face,
        typer.Option(
            "--face",
            help="zenoh: the protocol of rmw_zenoh, needs no ROS 2 here; rclpy: any middleware, needs ROS 2 here.",
        ),
    ] = Face.ZENOH,
    domain: Annotated[
        int, typer.Option("--domain", envvar="ROS_DOMAIN_ID", min=0, max=232, help="Domain of the ROS 2 nodes.")
    ] = 0,
    namespace: Annotated[
        str, typer.Option("--namespace", help="Prefix of all relative topics, such as /truck1: for several robots.")
    ] = "/",
    prefix: Annotated[
        str, typer.Option("--frame-prefix", help="Prefix of all frames, such as truck1/: for several robots.")
    ] = "",
    connect: Annotated[
        str | None,
        typer.Option("--connect", metavar="ENDPOINT", help="Running Zenoh router of ROS 2 (`rmw_zenohd`) to join."),
    ] = None,
    listen: Annotated[
        str,
        typer.Option(
            "--listen",
            metavar="ENDPOINT",
            help="Without --connect: the address for ROS 2 nodes; the next free port if it is taken.",
        ),
    ] = "tcp/127.0.0.1:7447",
    distribution: Annotated[
        Distribution,
        typer.Option(
            "--distro", help="ROS 2 distribution. One program serves Jazzy, Kilted and Lyrical; Humble needs its own."
        ),
    ] = Distribution.JAZZY,
    map_to_odom: Annotated[
        bool, typer.Option(help="Publish map to odom; switch off if slam_toolbox or amcl does.")
    ] = True,
    odom_to_base: Annotated[
        bool, typer.Option(help="Publish odom to base_link; switch off if robot_localization does.")
    ] = True,
    clock: Annotated[bool, typer.Option("--clock", help="Publish /clock, for nodes with use_sim_time.")] = False,
    drive: Annotated[
        bool,
        typer.Option(help="Let ROS 2 nodes drive, arm and send goals; they can always trigger the emergency stop."),
    ] = True,
) -> None:
    """Show the robot to ROS 2 as a node, and pass on what ROS 2 nodes ask of it.

    It is a client of the robot like any other. With face zenoh it speaks to rmw_zenoh
    (RMW_IMPLEMENTATION=rmw_zenoh_cpp), and ROS 2 need not be installed here.
    """
    for name, endpoint in (("--connect", connect), ("--listen", listen)):
        if endpoint is not None and not is_endpoint(endpoint):
            raise InputError(f"{name} {endpoint!r}: expected tcp/HOST:PORT")
    if not namespace.startswith("/"):
        raise InputError(f"--namespace {namespace!r}: expected a name that begins with /")
    with needs_extra("ros2"):
        from monstertruckd.ros2.face import FaceOptions
        from monstertruckd.ros2.serve import RVIZ, rclpy_node, serve_face, zenoh_node
        from monstertruckd.ros2.zenoh_node import free_endpoint, session_settings
    from monstertruckd.station.address import RobotAddress

    address = RobotAddress.default() if robot is None else RobotAddress.parse(robot)
    own = free_endpoint(listen)
    options = FaceOptions(prefix, map_to_odom, odom_to_base, clock, drive)
    hashed = distribution is not Distribution.HUMBLE

    node = (address.name, namespace)

    def ready() -> None:
        remark(f"ros2: robot {address.name} is node {namespace.rstrip('/')}/{address.name} of domain {domain}")
        remark(f"ros2: RViz: rviz2 -d {RVIZ}")
        if connect is None and face is Face.ZENOH:
            remark(f"ros2: nodes connect with ZENOH_CONFIG_OVERRIDE='connect/endpoints=[\"{own}\"]'")

    async def serve(wall: "WallClock") -> None:
        settings = session_settings(connect, own)

        def join() -> "AbstractAsyncContextManager[RosNode]":
            if face is Face.RCLPY:
                return rclpy_node(node, domain)
            return zenoh_node(node, domain, settings, wall, hashed=hashed)

        await serve_face(address, join, robot_facts, options, wall, ready)

    until_stopped(serve)


def robot_facts(config: "TruckConfig") -> "RobotFacts":
    """What ROS 2 needs of a configuration."""
    from monstertruck_kinematics.description import urdf
    from monstertruckd.ros2.facts import RobotFacts, WheelJoints
    from monstertruckd.tools.cli.description import described

    try:
        description = urdf(described(config))
    except InputError:  # its body has none
        description = None
    geometry, camera = config.geometry, config.devices.camera
    wheels = None
    if config.body.kind in ("truck", "ackermann"):
        wheels = WheelJoints(config.chassis(), geometry.track, geometry.drive_ratio)
    lens = None if camera is None else getattr(camera.driver, "lens", None)
    localised = config.slam is None or config.slam.mode != "ros2"
    planner = config.planner
    return RobotFacts(
        geometry.length,
        geometry.width,
        lens,
        description,
        wheels,
        localised=localised,
        mapped=localised or (config.own_planner is not None and config.own_planner.map is not None),
        plans=planner is None or planner.mode != "ros2",
    )
