"""Runs the bridge: a session with the robot and a ROS 2 node."""

import json
import logging
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from pathlib import Path
from typing import Any, Final

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.stations import tls_for
from monstertruck_schemas.req import Role
from monstertruckd.config.truck import TruckConfig
from monstertruckd.ros2.face import FaceOptions, RosFace
from monstertruckd.ros2.facts import RobotFacts
from monstertruckd.ros2.node import RosNode
from monstertruckd.ros2.operators import Operators
from monstertruckd.station.address import RobotAddress
from monstertruckd.station.remarks import Remarks

log = logging.getLogger(__name__)

RVIZ: Final = Path(__file__).parent / "robot.rviz"
"""Configuration of RViz for one robot without a namespace."""
TIMEOUT: Final = 2.5
"""Timeout of the robot's answer (s)."""


@asynccontextmanager
async def zenoh_node(
    name: tuple[str, str], domain: int, settings: Mapping[str, Any], clock: Clock, *, hashed: bool
) -> AsyncIterator[RosNode]:
    """Open a node on the wire of ``rmw_zenoh``; arguments and errors of ``ZenohNode``."""
    from monstertruckd.ros2.zenoh_node import ZenohNode  # noqa: PLC0415 - each face has libraries of its own

    async with ZenohNode(name, domain, settings, clock, hashed=hashed) as node:
        yield node


@asynccontextmanager
async def rclpy_node(name: tuple[str, str], domain: int) -> AsyncIterator[RosNode]:
    """Open a node of the installed ROS 2; arguments and errors of ``RclpyNode``."""
    from monstertruckd.ros2.rclpy_node import RclpyNode  # noqa: PLC0415

    async with RclpyNode(name, domain) as node:
        yield node
        if node.missing:
            log.warning("not offered because their packages are not installed: %s", ", ".join(sorted(node.missing)))


async def serve_face(
    address: RobotAddress,
    join: Callable[[], AbstractAsyncContextManager[RosNode]],
    facts: Callable[[TruckConfig], RobotFacts],
    options: FaceOptions,
    clock: Clock,
    ready: Callable[[], object],
) -> None:
    """Connect a robot to ROS 2 until cancelled.

    Args:
        address: address of the robot.
        join: creates the node.
        facts: extracts the parts of the robot's configuration for ROS 2.
        options: options of the user.
        clock: time.
        ready: called once ROS 2 can discover the robot.

    Raises:
        TruckError: the robot or the router cannot be reached, or the robot already has a bridge.
    """
    remarks = Remarks(log)
    tls = tls_for(address.endpoint)
    owner = None if tls is None else tls.owner()

    async with address.session("ros2", clock, TIMEOUT) as client:
        running = await client.call("config")
        running.pop("sim", None)
        config = TruckConfig.model_validate_json(json.dumps(running))

        def connect(source: str) -> TruckClient:
            role = Role.TRACKER if source in config.gate.remote_trackers else Role.STATION
            return TruckClient(
                address.name, address.endpoint, source=source, role=role, clock=clock, timeout=TIMEOUT, tls=tls
            )

        async with join() as node:
            operators = Operators(connect, owner, clock, remarks.add)
            try:
                await RosFace(client, node, operators, facts(config), options, clock).run(ready)
            finally:
                await operators.close()
                remarks.tell()
