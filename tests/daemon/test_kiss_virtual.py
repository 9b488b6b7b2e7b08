"""Mapping with kiss-icp as scan matcher through the whole daemon: the pose is true, scans match."""

import numpy as np
import pytest

from monstertruck_schemas.health import LocalisationStatus
from tests.daemon.slam_kit import CONFIGS, driven, lap

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(300)]


@pytest.mark.long
def test_the_demos_lap_is_mapped_by_kiss_icp():
    assert "front: kiss" in (CONFIGS / "kiss.yaml").read_text()
    drive = driven("kiss.yaml", lap(16))
    assert np.hypot(*(drive.truth[-1, 1:3] - drive.truth[0, 1:3])) > 2.0
    assert drive.off().max() < 0.1
    assert {message.standing for message in drive.health} <= {LocalisationStatus.MAPPING, LocalisationStatus.DEGENERATE}
    assert np.mean([message.accepted for message in drive.health[5:]]) > 0.95
    assert drive.health[-1].keys > 5
