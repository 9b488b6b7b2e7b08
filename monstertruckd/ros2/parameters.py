"""Live settings of the robot as node parameters: the six services used by ``ros2 param`` and rqt."""

from collections.abc import Mapping
from typing import Any, Final

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.errors import InputError, TruckError
from monstertruckd.ros2.cdr import RosMessage
from monstertruckd.ros2.node import RosNode, RosSender
from monstertruckd.ros2.operators import Operators
from monstertruckd.ros2.rmw import RELIABLE

FIELDS: Final = {1: "bool_value", 2: "integer_value", 3: "double_value", 4: "string_value"}
"""Field of ``rcl_interfaces/msg/ParameterValue`` by ``rcl_interfaces/msg/ParameterType``."""
TYPES: Final = {bool: 1, int: 2, float: 3, str: 4}


BOUNDS: Final = (("above", "at_least"), ("below", "at_most"))
"""Keys of the minimum and maximum in a row."""


def value_of(value: Any) -> dict[str, Any]:
    """``rcl_interfaces/msg/ParameterValue`` of a setting."""
    number = TYPES[type(value)]
    return {"type": number, FIELDS[number]: value}


def plain_value(value: RosMessage) -> Any:
    """Return the value of a ``rcl_interfaces/msg/ParameterValue``.

    Raises:
        InputError: its type is not a plain value.
    """
    name = FIELDS.get(value["type"])
    if name is None:
        raise InputError(f"type {value['type']}: expected a bool, an integer, a double or a string")
    return value[name]


def descriptor(row: Mapping[str, Any]) -> dict[str, Any]:
    """``rcl_interfaces/msg/ParameterDescriptor`` of a row of the remote call ``settings``."""
    low, high = (next((row[name] for name in names if row[name] is not None), None) for names in BOUNDS)
    found = {"name": row["key"], "type": TYPES[type(row["value"])], "description": row["meaning"]}
    if low is None or high is None:
        return found
    if isinstance(row["value"], float):
        return found | {"floating_point_range": [{"from_value": low, "to_value": high}]}
    return found | {"integer_range": [{"from_value": int(low), "to_value": int(high)}]}


class RosParameters:
    """Serves the parameter services.

    Args:
        node: node of ROS 2.
        operators: sessions of the nodes that set parameters.
        client: client that reads the settings.
    """

    def __init__(self, node: RosNode, operators: Operators, client: TruckClient) -> None:
        self._operators = operators
        self._client = client
        interfaces = "rcl_interfaces/srv"
        node.serve("~/list_parameters", f"{interfaces}/ListParameters", self._list)
        node.serve("~/get_parameters", f"{interfaces}/GetParameters", self._get)
        node.serve("~/get_parameter_types", f"{interfaces}/GetParameterTypes", self._types)
        node.serve("~/describe_parameters", f"{interfaces}/DescribeParameters", self._describe)
        node.serve("~/set_parameters", f"{interfaces}/SetParameters", self._set)
        node.serve("~/set_parameters_atomically", f"{interfaces}/SetParametersAtomically", self._set_atomically)
        self._changed = node.publisher("/parameter_events", "rcl_interfaces/msg/ParameterEvent", RELIABLE)
        self._name = node.qualified("~/set_parameters").rpartition("/")[0]

    async def _rows(self) -> dict[str, dict[str, Any]]:
        """Return the settings by name; empty if the robot does not answer."""
        try:
            return {row["key"]: row for row in (await self._client.call("settings"))["settings"]}
        except TruckError as error:
            self._operators.refuse("a client", "parameters", str(error))
            return {}

    async def _list(self, request: RosMessage, _: RosSender | None) -> Mapping[str, Any]:
        prefixes, depth = request["prefixes"], request["depth"]

        def within(name: str) -> bool:
            """Return whether a name has one of the prefixes and at most the requested depth below it."""
            if not prefixes:
                return not depth or name.count(".") < depth
            below = [name.removeprefix(f"{prefix}.") for prefix in prefixes if name.startswith(f"{prefix}.")]
            return name in prefixes or any(not depth or rest.count(".") < depth for rest in below)

        names = [name for name in await self._rows() if within(name)]
        parents = sorted({name.rpartition(".")[0] for name in names if "." in name})
        return {"result": {"names": names, "prefixes": parents}}

    async def _get(self, request: RosMessage, _: RosSender | None) -> Mapping[str, Any]:
        rows = await self._rows()
        return {"values": [value_of(rows[name]["value"]) if name in rows else {} for name in request["names"]]}

    async def _types(self, request: RosMessage, _: RosSender | None) -> Mapping[str, Any]:
        rows = await self._rows()
        return {"types": [TYPES[type(rows[name]["value"])] if name in rows else 0 for name in request["names"]]}

    async def _describe(self, request: RosMessage, _: RosSender | None) -> Mapping[str, Any]:
        rows = await self._rows()
        return {
            "descriptors": [descriptor(rows[name]) if name in rows else {"name": name} for name in request["names"]]
        }

    async def _set(self, request: RosMessage, sender: RosSender | None) -> Mapping[str, Any]:
        return {"results": [await self._change([row], sender) for row in request["parameters"]]}

    async def _set_atomically(self, request: RosMessage, sender: RosSender | None) -> Mapping[str, Any]:
        return {"result": await self._change(request["parameters"], sender)}

    async def _change(self, rows: list[RosMessage], sender: RosSender | None) -> dict[str, Any]:
        try:
            if sender is None:
                raise InputError("the graph has no client of this service with this identity")
            values = {row["name"]: plain_value(row["value"]) for row in rows}
            await (await self._operators.session(sender)).call("set", {"values": values})
        except TruckError as error:
            return {"successful": False, "reason": str(error)}
        changed = [{"name": name, "value": value_of(value)} for name, value in values.items()]
        self._changed({"node": self._name, "changed_parameters": changed})
        return {"successful": True}
