"""Sessions of a face: the robot on one side, ROS 2 on the other."""

import json
import logging
from collections.abc import Callable, Mapping
from typing import Any

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.stations import tls_for
from monstertruckd.config.truck import TruckConfig
from monstertruckd.ros2.face import FaceOptions, RosFace
from monstertruckd.ros2.facts import RobotFacts
from monstertruckd.ros2.operators import Operators
from monstertruckd.ros2.zenoh_node import ZenohNode
from monstertruckd.station.address import RobotAddress
from monstertruckd.station.remarks import Remarks

log = logging.getLogger(__name__)

TIMEOUT = 2.5
"""Seconds in which the robot answers."""


async def serve_zenoh(
    address: RobotAddress,
    name: tuple[str, str],
    domain: int,
    settings: Mapping[str, Any],
    facts: Callable[[TruckConfig], RobotFacts],
    options: FaceOptions,
    clock: Clock,
    ready: Callable[[], object],
    *,
    hashed: bool = True,
) -> None:
    """Show a robot to ``rmw_zenoh`` until cancelled; see ``ZenohNode`` and ``RosFace`` for the arguments.

    Raises:
        TruckError: the robot or the router cannot be reached, or it has a face already.
    """
    remarks = Remarks(log)
    tls = tls_for(address.endpoint)
    owner = None if tls is None else tls.owner()

    def connect(source: str) -> TruckClient:
        return TruckClient(address.name, address.endpoint, source=source, clock=clock, timeout=TIMEOUT, tls=tls)

    async with address.session("ros2", clock, TIMEOUT) as client:
        running = await client.call("config")
        running.pop("sim", None)
        config = TruckConfig.model_validate_json(json.dumps(running))
        async with ZenohNode(name, domain, settings, clock, hashed=hashed) as node:
            operators = Operators(connect, owner, clock, remarks.add)
            try:
                await RosFace(client, node, operators, facts(config), options, clock).run(ready)
            finally:
                await operators.close()
                remarks.tell()
