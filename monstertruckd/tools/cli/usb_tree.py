"""The USB tree of a robot or of this machine, drawn or as a table."""

from collections.abc import Iterable
from typing import Final

from rich.text import Text
from rich.tree import Tree

from monstertruck_drivers.computer import Sysfs
from monstertruck_drivers.usb.config import UsbConfig
from monstertruck_drivers.usb.hub import HubCoordinator
from monstertruck_drivers.usb.tree import parent_of, port_of, read_tree, sort_key
from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import NotFoundError
from monstertruck_schemas.topics import USB
from monstertruck_schemas.usb import UsbNode, UsbState

STATE_STYLE = {
    UsbState.PRESENT: "green",
    UsbState.ABSENT: "bold red",
    UsbState.WAITING: "yellow",
    UsbState.HELD: "bold red",
}


async def robot_tree(client: TruckClient) -> tuple[UsbNode, ...]:
    """Return the latest USB tree that a running robot published.

    Raises:
        NotFoundError: the robot does not watch its USB tree.
    """
    tree = await client.get_retained(USB)
    if tree is None:
        raise NotFoundError(f"robot {client.robot!r} does not watch its USB tree; --local shows this machine's")
    return tree.nodes


async def local_tree(clock: Clock) -> tuple[UsbNode, ...]:
    """Return the current USB tree of this machine; only a daemon knows roles and replugs."""
    hubs = HubCoordinator(UsbConfig(), {}, clock, lambda *_, **__: None)
    hubs.update(read_tree(Sysfs()))
    return hubs.tree()


def draw(nodes: Iterable[UsbNode]) -> list[Tree]:
    """One tree per bus; a hub that has not been seen yet is shown by its name."""
    rows = {node.name: node for node in nodes}
    trees: dict[str, Tree] = {}
    roots = []

    def branch(name: str) -> Tree:
        if name not in trees:
            parent = parent_of(name)
            label = _label(name, rows.get(name))
            trees[name] = Tree(label) if parent is None else branch(parent).add(label)
            if parent is None:
                roots.append(trees[name])
        return trees[name]

    for name in sorted(rows, key=sort_key):
        branch(name)
    return roots


def _label(name: str, node: UsbNode | None) -> Text:
    label = Text(name if parent_of(name) is None else f"port {port_of(name)}", style="dim")
    if node is None:
        return label.append(f"  {name} never connected", style=STATE_STYLE[UsbState.ABSENT])
    if node.hub:
        label.append(f"  hub {name}", style="bold")
    if node.role is not None:
        label.append(f"  {node.role}", style="bold cyan")
    label.append(f"  {' '.join(part for part in (node.title, node.usb_id, node.tty) if part)}", style="default")
    label.append(f"  {node.state.value}", style=STATE_STYLE[node.state])
    for remark in _remarks(node):
        label.append(f"  {remark}", style="yellow")
    return label


def _remarks(node: UsbNode) -> list[str]:
    remarks = []
    if node.replugs:
        remarks.append(f"{node.replugs} replug{'s' if node.replugs > 1 else ''}")
    if node.over_current:
        remarks.append(f"over-current {node.over_current}")
    if node.autosuspend and not node.hub:
        remarks.append("may be suspended")
    if node.latency_ms is not None:
        remarks.append(f"latency {node.latency_ms} ms")
    return remarks


HEADINGS: Final = ("hub", "port", "role", "state", "replugs", "id", "node", "device")


def rows(nodes: Iterable[UsbNode]) -> list[tuple[str, ...]]:
    """Return the tree as rows of a table, for pipes."""
    found = []
    for node in nodes:
        remarks = [remark for remark in _remarks(node) if "replug" not in remark]
        cells = (node.role, node.state.value, str(node.replugs), node.usb_id, node.tty, node.title)
        *others, title = (cell or "-" for cell in cells)
        place = node.parent or node.name, str(port_of(node.name) or "-")
        found.append((*place, *others, ", ".join((title, *remarks))))
    return found
