"""What ``monstertruckd try`` adds to a robot."""

import socket
from pathlib import Path

import pytest

from monstertruck_runtime.errors import ConfigError
from monstertruckd.tools.demo import tryout
from monstertruckd.tools.demo.tryout import free_port, open_page, robot_file, write_tryout
from monstertruckd.tools.shipped import shipped

ENDPOINT = "tcp/127.0.0.1:7555"
ROBOTS = sorted(file.stem for file in shipped("configs/robots").glob("*.yaml"))
BY_HAND = {"donkeycar", "synchro", "skid_stand", "sonar"}
"""Robots for whose body, or without a tracker, there is no planner."""
WITHOUT_LIDAR = {"donkeycar", "skid_stand", "sonar"}


@pytest.mark.parametrize("name", ROBOTS)
def test_every_robot_gets_a_person_and_what_its_body_allows(name: str, tmp_path: Path):
    file, config = write_tryout(robot_file(Path(name)), tmp_path, ENDPOINT)
    assert file.parent == tmp_path
    assert len(config.sim.world.people) == 1
    assert config.path is None, "arming alone does not set it off"
    assert (config.planner is None, config.explorer is None) == (name in BY_HAND,) * 2
    assert (config.slam is None) == (name in WITHOUT_LIDAR)
    if config.slam is not None:
        assert config.slam.save == tmp_path / "explored"
    assert config.zenoh.listen == (ENDPOINT,)


def test_the_default_truck_explores_and_the_truck_is_the_emulated_one(tmp_path: Path):
    assert write_tryout(robot_file(Path("explore")), tmp_path, ENDPOINT)[1].planner is not None
    assert robot_file(Path("truck")) == shipped("configs/robots/truck.yaml")
    assert robot_file(Path("goals")) == shipped("configs/goals.yaml")
    with pytest.raises(ConfigError, match="describes a real robot"):
        write_tryout(shipped("configs/truck.yaml"), tmp_path, ENDPOINT)


def test_another_port_is_taken_where_the_wanted_one_is_in_use():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert free_port(port) != port
    assert free_port(port) == port


def test_no_browser_is_opened_without_a_screen(monkeypatch: pytest.MonkeyPatch):
    opened: list[str] = []
    monkeypatch.setattr(tryout.webbrowser, "open", lambda url: not opened.append(url))
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert not open_page("http://a/")
    monkeypatch.setenv("DISPLAY", ":0")
    assert open_page("http://a/")
    assert opened == ["http://a/"]
