"""The short log, finished and cut off."""

import shutil
from pathlib import Path

import pytest

from tests.unit.tools.logs.run_kit import write


@pytest.fixture(scope="module")
def master(tmp_path_factory):
    file = tmp_path_factory.mktemp("master") / "run-000001-000.mcap"
    return file, write(file)


@pytest.fixture
def log(master, tmp_path):
    return Path(shutil.copy(master[0], tmp_path))


@pytest.fixture
def cut(log):
    log.write_bytes(log.read_bytes()[: int(log.stat().st_size * 0.6)])
    return log
