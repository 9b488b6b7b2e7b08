"""The page's scripts before TypeScript: their types are inferred, and written in comments where that is not enough."""

import shutil
import subprocess
from pathlib import Path

import pytest

TSC = shutil.which("tsc")


@pytest.mark.skipif(TSC is None, reason="no TypeScript on this computer (npm install --global typescript@5.9)")
def test_the_scripts_of_the_page_have_no_wrong_types():
    """Takes 8 s of processor time: the compiler reads the types of the whole browser."""
    config = Path(__file__).with_name("tsconfig.json")
    checked = subprocess.run([str(TSC), "--project", str(config)], capture_output=True, text=True, check=False)
    assert checked.stdout == ""
