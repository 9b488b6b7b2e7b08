"""Robots of one world: names for each, and what they may not share."""

from pathlib import Path

import pytest

from monstertruck_runtime.errors import InputError
from monstertruck_sim.console import CommandedGroup
from monstertruckd.config.load import load_tree
from monstertruckd.tools.simulation.config import load_simulated, with_overlay
from monstertruckd.tools.simulation.fleet import as_fleet

FOLDER = Path(__file__).resolve().parents[3] / "configs" / "fleet"
LEADER, SECOND = (load_simulated(FOLDER / f"{name}.yaml") for name in ("leader", "second"))


def test_the_robots_name_stands_in_ports_and_folders_of_shared_files():
    assert LEADER.devices.lidar.port.path.parts[-2:] == ("leader", "lidar")
    assert SECOND.devices.lidar.port.path.parts[-2:] == ("second", "lidar")
    assert str(SECOND.state_directory) == "runs/second/state"


def test_a_configuration_without_a_name_has_the_default_one(tmp_path: Path):
    file = tmp_path / "truck.yaml"
    file.write_text('version: 2\nstate_directory: "runs/{robot}"\ndevices: {}\nx: [["{robot}/{robot}"], 1]\n')
    assert load_tree(file).data["state_directory"] == "runs/truck"
    assert load_tree(file).data["x"] == [["truck/truck"], 1]


def test_robots_of_one_world_have_noise_of_their_own():
    one, two = as_fleet([LEADER, SECOND])
    assert one.sim.seed != two.sim.seed


def test_two_robots_of_one_name_are_refused():
    with pytest.raises(InputError) as caught:
        as_fleet([LEADER, LEADER])
    assert "robot leader: used by leader and leader" in str(caught.value)


@pytest.mark.parametrize(
    ("overlay", "said"),
    [
        (
            {"devices": {"lidar": {"port": {"path": LEADER.devices.lidar.port.path}}}},
            "leader/lidar: used by leader and second",
        ),
        ({"zenoh": {"listen": ("tcp/127.0.0.1:7447",)}}, "zenoh.listen tcp/127.0.0.1:7447: used by leader and second"),
        ({"state_directory": Path("runs/leader/state")}, "state_directory runs/leader/state"),
        ({"sim": {"world": {"map": "rooms"}}}, "second: sim.world.map is rooms: expected the value of leader, yard"),
        (
            {"sim": {"world": {"engine": "mujoco"}}},
            "second: sim.world.engine is mujoco: expected the value of leader, plane",
        ),
        ({"sim": {"world": {"rough": ({"x": 1.0, "y": 0.0},)}}}, "second: sim.world.rough is (RoughPatch(x=1.0"),
        ({"sim": {"world": {"people": ({},)}}}, "second: sim.world.people: expected none, or the same as leader"),
    ],
)
def test_what_two_robots_claim_is_refused(overlay, said):
    with pytest.raises(InputError) as caught:
        as_fleet([LEADER, with_overlay(SECOND, overlay)])
    assert said in str(caught.value)


def test_two_emulated_computers_need_two_links():
    monitored = {"monitors": {"link": {"kind": "link_quality"}}, "machine": Path("runs/machine")}
    with pytest.raises(InputError, match="machine runs/machine"):
        as_fleet([with_overlay(LEADER, monitored), with_overlay(SECOND, monitored)])


class Said:
    def __init__(self):
        self.words = []

    def command(self, words):
        self.words.append(words)


def test_a_command_names_the_robot_then_the_device():
    one, two = Said(), Said()
    robots = CommandedGroup("robot", {"a": CommandedGroup("device", {"lidar": one, "drive": two})})
    robots.command(["a", "lidar", "unplug"])
    robots.command(["drive", "plug"])  # the only robot may be left out
    assert (one.words, two.words) == ([["unplug"]], [["plug"]])
    with pytest.raises(InputError, match="start the line with a device: lidar, drive"):
        robots.command(["a", "plug"])
    several = CommandedGroup("robot", {"a": one, "b": two})
    with pytest.raises(InputError, match="start the line with a robot: a, b"):
        several.command(["lidar", "plug"])
