"""Unit tests know nothing of the robots that other tests run on this computer."""

import pytest

from monstertruck_runtime import robots


@pytest.fixture(autouse=True)
def _alone_on_this_computer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robots, "local_endpoints", lambda **_: [])
