"""Builds the interfaces missing in the wheels of ROS 2 with ``rosidl``, for real ``rclpy``.

    PYTHON -m benchmarks.ros2_parts.build_messages

``PYTHON`` is a virtual environment of Python 3.12; ROS 2 need not be installed. It needs the wheels
``ros-jazzy-rclpy[fastrtps]``, ``ros-jazzy-sensor-msgs``, ``-nav-msgs``, ``-std-srvs``, ``-diagnostic-msgs``,
``-visualization-msgs``, ``-python-cmake-module``, all of ``ros-jazzy-ament-cmake*`` and ``ros-jazzy-rosidl*``,
``ros-ament-package``, ``catkin_pkg``, ``empy==3.3.4``, and this program's own dependencies (extra ``ros2``). CMake and
a C++ compiler are needed, too. The packages of ``monstertruckd/ros2/interfaces.txt`` that cannot be imported
(``tf2_msgs``, ``nav2_msgs`` ...) are installed into its prefix. Prints their names.
"""

import importlib.util
import os
import re
import subprocess
import sys
import sysconfig
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks import ROOT

INTERFACES = ROOT / "monstertruckd" / "ros2" / "interfaces.txt"

CMAKE = """cmake_minimum_required(VERSION 3.8)
project({name})
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
{found}
rosidl_generate_interfaces({name} {files} DEPENDENCIES {needed})
ament_package()
"""
PACKAGE = """<package format="3"><name>{name}</name><version>1.0.0</version><description>interfaces</description>
<maintainer email="none@example.org">none</maintainer><license>none</license>
<buildtool_depend>ament_cmake</buildtool_depend><buildtool_depend>rosidl_default_generators</buildtool_depend>
{needed}<member_of_group>rosidl_interface_packages</member_of_group></package>
"""


def packages() -> dict[str, dict[str, str]]:
    """Return the texts of files by package, in the edition of Jazzy, which has no suffix."""
    found: dict[str, dict[str, str]] = {}
    for part in INTERFACES.read_text(encoding="utf-8").split("=== ")[1:]:
        name, _, text = part.partition("\n")
        package, group, own = name.split("/")
        if "@" not in own:
            found.setdefault(package, {})[f"{group}/{own}.{group}"] = text
    return found


def mend_paths() -> None:
    """Replace the Python paths of the computer that built the wheels."""
    numpy = importlib.util.find_spec("numpy")
    assert numpy is not None
    assert numpy.origin is not None
    places = {
        r"[^\";]*/site-packages/numpy/_core/include": str(Path(numpy.origin).parent / "_core" / "include"),
        r"/opt/python/[^\";]*/include/python[\d.]+": sysconfig.get_path("include"),
    }
    for file in Path(sys.prefix).glob("share/*/cmake/export_*generator_pyExport.cmake"):
        text = file.read_text(encoding="utf-8")
        for pattern, place in places.items():
            text = re.sub(pattern, place, text)
        file.write_text(text, encoding="utf-8")


def build(name: str, files: dict[str, str], folder: Path) -> None:
    """Build and install one package."""
    own = {word for text in files.values() for word in re.findall(r"^(\w+)/", text, re.MULTILINE)} - {name}
    actions = any(file.startswith("action/") for file in files)
    needed = sorted(own | ({"action_msgs", "unique_identifier_msgs"} if actions else set()))
    for file, text in files.items():
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_text(text, encoding="utf-8")
    found = "\n".join(f"find_package({one} REQUIRED)" for one in needed)
    rows = {"name": name, "files": " ".join(f'"{file}"' for file in files), "found": found, "needed": " ".join(needed)}
    (folder / "CMakeLists.txt").write_text(CMAKE.format(**rows), encoding="utf-8")
    depends = "".join(f"<depend>{one}</depend>" for one in needed)
    (folder / "package.xml").write_text(PACKAGE.format(name=name, needed=depends), encoding="utf-8")
    prefix = Path(sys.prefix)
    environment = os.environ | {
        "PATH": f"{prefix / 'bin'}:{os.environ['PATH']}",
        "AMENT_PREFIX_PATH": str(prefix),
        "LD_LIBRARY_PATH": str(prefix / "lib"),
    }
    environment.pop("PYTHONPATH", None)
    options = [
        f"-DCMAKE_PREFIX_PATH={prefix}",
        f"-DCMAKE_INSTALL_PREFIX={prefix}",
        f"-DPython3_EXECUTABLE={sys.executable}",
    ]
    options += ["-DBUILD_TESTING=OFF"]
    for words in (["cmake", "-S", ".", "-B", "build", *options], ["cmake", "--build", "build", "--target", "install"]):
        subprocess.run(words, cwd=folder, env=environment, check=True, stdout=sys.stderr)


def main() -> None:
    """Build what is missing."""
    mend_paths()
    for name, files in packages().items():
        if importlib.util.find_spec(name) is None:
            with TemporaryDirectory(prefix=f"{name}-") as folder:
                build(name, files, Path(folder))
            print(name, flush=True)


if __name__ == "__main__":
    main()
