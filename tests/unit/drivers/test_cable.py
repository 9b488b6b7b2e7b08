"""Names of emulated ports: nobody else's are taken."""

import subprocess
import sys
from pathlib import Path

import pytest

from monstertruck_drivers.cable import reserved
from monstertruck_runtime.errors import BusyError, InputError

HOLD = """
import sys
from pathlib import Path
from monstertruck_drivers.cable import reserved
with reserved(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_a_port_that_another_program_serves_is_busy_until_it_ends(tmp_path: Path):
    link = tmp_path / "lidar"
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(link)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        for _ in range(2):  # who is refused does not forget who holds it
            with (
                pytest.raises(BusyError, match=rf"lidar: another program \(process {other.pid}\) serves this port"),
                reserved(link),
            ):
                pass
        other.kill()
    with reserved(tmp_path / "drive", link):
        pass
    assert list(tmp_path.iterdir()) == []


def test_what_is_no_link_keeps_its_name(tmp_path: Path):
    file = tmp_path / "notes"
    file.write_text("precious")
    with pytest.raises(InputError, match="notes: already exists and is not a link"), reserved(file):
        pass
    assert file.read_text() == "precious"


def test_the_link_of_a_program_that_was_killed_is_replaced(tmp_path: Path):
    link = tmp_path / "lidar"
    link.symlink_to("/dev/pts/nowhere")
    (tmp_path / ".lidar.lock").touch()
    with reserved(link):
        pass


def test_a_place_without_rights_is_named():
    with pytest.raises(OSError, match=r"'/proc/lidar'"), reserved(Path("/proc/lidar")):
        pass
