"""Calibration, newest log, wireless networks and cards, and which fixes may be run."""

from pathlib import Path

import numpy as np
import pytest

from monstertruck_schemas.reasons import Reason
from monstertruckd.config.calibration import CalibrationStore, Estimate, Result
from monstertruckd.tools.doctor import computer, history
from monstertruckd.tools.doctor.context import safe_fix
from tests.unit.tools.doctor.kit import NOW, EmulatedHost, bad, see

DAY = 86_400


def calibrated(made: EmulatedHost, half: float, days: int) -> None:
    folder = made.context.logs().parent / made.context.config.calibration_folder
    estimate = Estimate(name="drive_ratio", value=600.0, low=600 - half, high=600 + half, samples=4, meaning="test")
    result = Result(wizard="drive", measured="test", estimates=(estimate,))
    CalibrationStore(folder, made.context.config.robot).save(result, round((NOW - days * DAY) * 1e9))


def test_no_calibration_is_a_warning(tmp_path: Path):
    found = see(tmp_path, history.calibration)
    assert found["calibration"].reason is Reason.CALIBRATION_EXPIRED
    assert "calibrate all" in found["calibration"].fix


@pytest.mark.parametrize(("half", "days", "said"), [(3.0, 10, None), (3.0, 400, "valid until"), (20.0, 10, "grade C")])
def test_age_and_grade(half, days, said, tmp_path: Path):
    found = see(tmp_path, history.calibration, lambda made: calibrated(made, half, days))
    wrong = bad(found)
    assert bool(wrong) is (said is not None)
    if said:
        assert said in wrong["calibration drive"].seen


@pytest.mark.parametrize(
    ("path", "text", "said"),
    [
        ("etc/NetworkManager/system-connections/cafe.nmconnection", "[wifi]\nssid=cafe\n", "cafe is open"),
        (
            "etc/NetworkManager/system-connections/old.nmconnection",
            "[wifi]\nssid=old\n[wifi-security]\nkey-mgmt=none\nwep-key0=x\n",
            "old is WEP",
        ),
        (
            "etc/NetworkManager/system-connections/home.nmconnection",
            "[wifi]\n[wifi-security]\nkey-mgmt=wpa-psk\n",
            None,
        ),
        ("etc/wpa_supplicant/wpa_supplicant.conf", 'network={\n ssid="hall"\n key_mgmt=NONE\n}\n', "hall is open"),
        ("etc/wpa_supplicant/wpa_supplicant.conf", 'network={\n ssid="lab"\n psk="secret"\n}\n', None),
    ],
)
def test_wireless(path, text, said, tmp_path: Path):
    found = bad(see(tmp_path, computer.wireless, lambda made: made.put(path, text) and None))
    assert ("wireless" in found) is (said is not None)
    if said:
        assert said in found["wireless"].seen


@pytest.mark.parametrize(
    ("life", "end", "worn"), [("0x01 0x02", "0x01", False), ("0x02 0x09", "0x01", True), ("0x03 0x03", "0x02", True)]
)
def test_a_worn_card(life, end, worn, tmp_path: Path):
    def put(made: EmulatedHost) -> None:
        made.put("sys/block/mmcblk0/device/life_time", life + "\n")
        made.put("sys/block/mmcblk0/device/pre_eol_info", end + "\n")

    assert ("card" in bad(see(tmp_path, computer.card, put))) is worn


def test_a_damaged_log_is_a_finding(tmp_path: Path):
    def put(made: EmulatedHost) -> None:
        (made.context.logs() / "run.mcap").write_bytes(b"no log")

    assert "log" in bad(see(tmp_path, history.newest_log, put))


def test_a_compass_that_turns_against_the_wheels():
    times = np.arange(0, 20, 0.05) * 1e9
    yaw = np.sin(times * 1e-9)
    for sign, wrong in ((1, False), (-1, True)):
        series = {
            "sensor/compass": np.column_stack((times, sign * yaw)),
            "state/odometry": np.column_stack((times, yaw)),
        }
        (found,) = history._signs(series, "log")
        assert (found.reason is not Reason.OK) is wrong


def test_steering_at_its_limit():
    (found,) = history._saturated([(0.3, 0.0)] * 60 + [(0.1, 0.0)] * 60, "log")
    assert found.reason is Reason.SERVO_LIMIT
    assert not list(history._saturated([(0.3, 0.0)] * 5 + [(0.1, 0.0)] * 200, "log"))


@pytest.mark.parametrize(
    ("fix", "safe"),
    [
        ("sudo timedatectl set-ntp true", True),
        ("sudo chmod 600 /etc/key", True),
        ("sudo /usr/bin/python -m monstertruckd install-service --config a.yaml", True),
        ("sudo /usr/bin/python -m monstertruckd install-service --config FILE", False),
        ("echo 1 | sudo tee /sys/x", False),
        ("sudo chgrp dialout a && sudo chmod g+rw a", False),
        ("du -xh . | sort", False),
        ("journalctl -e", False),
        (None, False),
    ],
)
def test_what_may_be_run_unseen(fix, safe):
    assert (safe_fix(fix) is not None) is safe
