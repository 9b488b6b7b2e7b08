"""Several robots in one simulated world: shared and individual parts of their configurations."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from monstertruck_drivers.usb.config import UsbPortConfig
from monstertruck_runtime.errors import InputError
from monstertruck_sim.world.scene import Surroundings
from monstertruck_sim.world.world import make_scene
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, needs_computer

SHARED: Final = ("map", "engine", "rough", "ground", "height_image", "mjcf")
"""Common settings of robots in one world."""


def as_fleet(configs: Sequence[SimulatedTruckConfig]) -> list[SimulatedTruckConfig]:
    """Return configurations of robots of one world, each with its own noise.

    Map, engine, ground, people and seed of the world come from the first one.

    Raises:
        InputError: two of them claim the same resource, or describe different worlds; the text names both.
    """
    first = configs[0]
    for config in configs[1:]:
        for name in SHARED:
            value, expected = getattr(config.sim.world, name), getattr(first.sim.world, name)
            if value != expected:
                raise InputError(
                    f"{config.robot}: sim.world.{name} is {value}: expected the value of {first.robot}, {expected}"
                )
        if config.sim.world.people not in ((), first.sim.world.people):
            raise InputError(f"{config.robot}: sim.world.people: expected none, or the same as {first.robot}")
    _require_apart(configs, "robot", lambda config: [config.robot])
    _require_apart(configs, "devices: port", _ports)
    _require_apart(configs, "zenoh.listen", lambda config: config.zenoh.listen)
    _require_apart(configs, "state_directory", lambda config: [config.state_directory])
    _require_apart(configs, "machine", _machines)
    return [
        config.model_copy(update={"sim": config.sim.model_copy(update={"seed": config.sim.seed + 1000 * i})})
        for i, config in enumerate(configs)
    ]


def shared_scene(configs: Sequence[SimulatedTruckConfig]) -> Surroundings:
    """Return the world of a fleet, without its robots."""
    first, *others = (config.sim for config in configs)
    return make_scene(first.world, first.seed, [other.world for other in others])


def _ports(config: SimulatedTruckConfig) -> Iterator[str]:
    ports = (device.port for device in config.devices.present().values())
    return (port.label for port in ports if not isinstance(port, UsbPortConfig))


def _machines(config: SimulatedTruckConfig) -> Iterator[Path]:
    """Yield the link to the emulated computer if the daemon needs one."""
    if needs_computer(config):
        yield config.machine


def _require_apart(
    configs: Sequence[SimulatedTruckConfig], what: str, claims: Callable[[SimulatedTruckConfig], Iterable[Any]]
) -> None:
    owners: dict[Any, int] = {}
    for i, config in enumerate(configs):
        for claim in claims(config):
            if (owner := owners.setdefault(claim, i)) != i:
                raise InputError(
                    f"{what} {claim}: used by {configs[owner].robot} and {config.robot}: expected one each"
                )
