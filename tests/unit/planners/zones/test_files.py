"""Zones from files: polygons, masks of Nav2 in its three modes, the operators' own; what is refused by its key."""

import json

import numpy as np
import pytest
from PIL import Image

from monstertruck_planners.zones import files
from monstertruck_planners.zones.config import KeepoutMaskConfig, SpeedMaskConfig, ZonesConfig
from monstertruck_planners.zones.shapes import limits_of
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.zones import ZoneArea

AREA = ZoneArea(kind="keepout", corners=((0.0, 0.0), (1.0, 0.0), (1.0, 1.0)))
INF = np.inf


def mask_file(folder, shades, mode="trinary", **keys):
    Image.fromarray(np.array(shades, np.uint8)).save(folder / "mask.png")
    values = {"image": "mask.png", "mode": mode, "resolution": 0.1, "origin": [1.0, 2.0, 0.0], "negate": 0}
    values |= {"occupied_thresh": 0.65, "free_thresh": 0.25, **keys}
    file = folder / "mask.yaml"
    file.write_text(json.dumps(values))
    return file


def test_polygons_come_from_the_configuration_and_from_a_file_of_their_own(tmp_path):
    file = tmp_path / "zones.yaml"
    file.write_text("zones:\n  ramp: { kind: speed, limit: 0.2, corners: [[0, 0], [1, 0], [1, 1]] }\n")
    found, remarks = files.configured(ZonesConfig(areas={"stairs": AREA}, file=file), 0.5)
    assert [(zone.name, zone.kind, zone.limit, zone.saved) for zone in found] == [
        ("stairs", "keepout", None, False),
        ("ramp", "speed", 0.2, False),
    ]
    assert remarks == []
    with pytest.raises(InputError, match=r"zones\.yaml: zones\.ramp: the configuration has a zone of this name"):
        files.configured(ZonesConfig(areas={"ramp": AREA}, file=file), 0.5)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("zones: { ramp: { kind: speed, corners: [[0, 0], [1, 0], [1, 1]] } }", "limit: expected for a speed zone"),
        ("zones: { a: { kind: keepout, corners: [[0, 0], [1, 0]] } }", "corners"),
        ("zones: { a: { kind: keepout, corners: [[0, 0], [1, 0], [2, 0]] } }", "expected a polygon of at least 1 cm"),
        ("zones: { speed_mask: { kind: keepout, corners: [[0, 0], [1, 0], [1, 1]] } }", "expected another name"),
        ("zones: { a: { kind: speed, limit: 1, inside: leave, corners: [[0, 0], [1, 0], [1, 1]] } }", "keepout zones"),
        ("areas: {}", "areas"),
    ],
)
def test_a_file_that_is_wrong_is_refused_with_its_key(tmp_path, text, said):
    file = tmp_path / "zones.yaml"
    file.write_text(text)
    with pytest.raises(InputError, match=said) as refused:
        files.configured(ZonesConfig(file=file), 0.5)
    assert str(file) in str(refused.value)


def test_a_keepout_mask_closes_what_is_lethal_in_nav2_and_remarks_on_the_rest(tmp_path):
    config = ZonesConfig(keepout_mask=KeepoutMaskConfig(map=mask_file(tmp_path, [[0, 255], [205, 0]]), inside="leave"))
    (zone,), remarks = files.configured(config, 0.5)
    assert (zone.name, zone.kind, zone.inside, remarks) == ("keepout_mask", "keepout", "leave", [])
    assert limits_of(zone.mask).tolist() == [[INF, 0.0], [0.0, INF]], "row 0 is the lowest"
    scale = mask_file(tmp_path, [[0, 120], [255, 255]], "scale")
    (zone,), remarks = files.configured(ZonesConfig(keepout_mask=KeepoutMaskConfig(map=scale)), 0.5)
    assert limits_of(zone.mask).tolist() == [[0.0]]
    assert "1 cells of values 1 to 99" in remarks[0]
    with pytest.raises(InputError, match=r"mask\.yaml: contains no zone cells"):
        files.configured(ZonesConfig(keepout_mask=KeepoutMaskConfig(map=mask_file(tmp_path, [[255]]))), 0.5)


@pytest.mark.parametrize(
    ("numbers", "limits"),
    [
        ({"type": "percent"}, [INF, 0.005, 0.25, 0.5, INF]),
        ({"type": "percent", "base": 100.0, "multiplier": -1.0}, [INF, 0.495, 0.25, INF, INF]),
        ({"type": "percent", "multiplier": 1.5}, [INF, 0.0075, 0.375, INF, INF]),
        ({"type": "absolute", "multiplier": 0.01}, [INF, 0.01, 0.5, 1.0, INF]),
        ({"type": "absolute", "base": 0.5, "multiplier": -0.01}, [INF, 0.49, INF, INF, INF]),
    ],
)
def test_a_raw_speed_mask_means_what_it_means_in_nav2(tmp_path, numbers, limits):
    """Values 0, 1, 50, 100 and unknown; without a limit: 0, unknown, percents above 100, and limits not above 0."""
    file = mask_file(tmp_path, [[0, 1, 50, 100, 255]], "raw")
    (zone,), _ = files.configured(ZonesConfig(speed_mask=SpeedMaskConfig(map=file, **numbers)), 0.5)
    row = limits_of(zone.mask)[0].tolist()
    first = round((zone.mask.x - 1.0) / 0.1)
    found = [INF] * first + row + [INF] * (5 - first - len(row))
    assert found == pytest.approx(limits)


def test_the_operators_zones_are_read_back_and_damage_is_said(tmp_path):
    file = tmp_path / "zones.json"
    assert files.load_saved(file) == {}
    files.save(file, {"stairs": AREA})
    assert files.load_saved(file) == {"stairs": AREA}
    file.write_text(file.read_text()[:40])
    with pytest.raises(InputError, match=r"zones\.json: expected zones"):
        files.load_saved(file)
