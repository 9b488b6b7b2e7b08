"""`drill` as a user sees it."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from monstertruck_schemas.reasons import Reason
from monstertruck_sim.faults import FaultKind
from monstertruckd.tools.cli import drill as command
from monstertruckd.tools.cli.main import main
from monstertruckd.tools.drill.campaign import Campaign, CampaignReport, TrialOutcome
from monstertruckd.tools.drill.legs import default_jobs
from monstertruckd.tools.drill.observer import Violation
from monstertruckd.tools.drill.random_drill import Drill, DrillReport, FaultOutcome

DEMO = Path(__file__).resolve().parents[4] / "configs" / "demo.yaml"
SAFE = FaultOutcome(
    "stall: lidar", FaultKind.STALL, True, stop_bytes_s=0.27, standstill_s=0.56, metres=0.07, recovered_s=0.9
)
UNSAFE = FaultOutcome(
    "stall: drive", FaultKind.STALL, True, violations=(Violation(0.7, "stop", "0.2 m/s: must stand"),)
)
STUCK = FaultOutcome("reset: compass", FaultKind.RESET, False, stuck=("compass",))


def run(monkeypatch: pytest.MonkeyPatch, outcomes: tuple[FaultOutcome, ...], *arguments: str) -> int:
    def drill(self: Drill, **_: Any) -> DrillReport:
        return DrillReport(self.seed, outcomes[: self.count])

    monkeypatch.setattr(Drill, "run", drill)
    monkeypatch.setattr(sys, "argv", ["monstertruckd", "drill", "--config", str(DEMO), *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    return int(ended.value.code or 0)


def test_a_report_names_fault_reaction_time_way_and_score(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    assert run(monkeypatch, (SAFE,), "--count", "1") == 0
    out = capsys.readouterr().out
    for word in ("stall: lidar", "stopped", "0.27", "0.56", "0.070", "0.90", "1 faults: 0 with unsafe motion"):
        assert word in out


@pytest.mark.parametrize(("outcome", "text"), [(UNSAFE, "must stand"), (STUCK, "not recovered: compass")])
def test_what_is_unsafe_or_stuck_is_the_exit_code_and_a_line(
    outcome: FaultOutcome, text: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    assert run(monkeypatch, (SAFE, outcome), "--count", "2") == 1
    assert text in capsys.readouterr().out


def test_json_holds_the_figures(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    assert run(monkeypatch, (SAFE, UNSAFE), "--json", "--seed", "5") == 1
    report = json.loads(capsys.readouterr().out)
    assert (report["seed"], report["faults"], report["unsafe"]) == (5, 2, 1)
    assert report["outcomes"][0]["fault"] == "stall: lidar"


TRIALS = (
    TrialOutcome(
        0,
        ("drive position_actual scaled", "memory full"),
        ("drive position_actual scaled", "memory full"),
        False,
        True,
        reason=Reason.SENSORS_DISAGREE,
        reason_s=0.4,
        recovered_s=0.7,
    ),
    TrialOutcome(
        1,
        ("lidar range frozen",),
        ("lidar range frozen",),
        False,
        False,
        stuck=("scan_stale",),
        violations=(Violation(1.2, "contact", "ran into something"),),
    ),
)


def run_families(monkeypatch: pytest.MonkeyPatch, outcomes: tuple[TrialOutcome, ...], *arguments: str) -> int:
    monkeypatch.setattr(Campaign, "run", lambda self, **_: CampaignReport(self.seed, outcomes))
    monkeypatch.setattr(sys, "argv", ["monstertruckd", "drill", "--families", "--config", str(DEMO), *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    return int(ended.value.code or 0)


def test_families_are_summarised_one_by_one_and_troubles_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    assert run_families(monkeypatch, TRIALS) == 1
    lines = capsys.readouterr().out.splitlines()
    (scaled,) = (line.split() for line in lines if line.endswith("drive position_actual scaled"))
    assert scaled[:7] == ["1", "1", "0.40", "0.40", "0", "0", "sensors_disagree"]
    (full,) = (line.split() for line in lines if line.endswith("  memory full"))
    assert full[:4] == ["1", "0", "-", "-"], "the reason is the other fault's"
    text = " ".join(lines)
    assert "trial 1, forwards, lidar range frozen: after 1.20 s contact: ran into something" in text
    assert "trial 1, forwards, lidar range frozen: not recovered: scan_stale" in text
    assert "2 trials, 1 of two faults, 1 in reverse: 1 with unsafe motion, 1 not recovered" in text


def test_safe_families_are_exit_code_0_and_json_holds_the_figures(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    assert run_families(monkeypatch, TRIALS[:1], "--json", "--seed", "5") == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["seed"], report["trials"], report["pairs"], report["stuck"]) == (5, 1, 1, 0)


def test_the_default_truck_is_shipped():
    assert command.FULL_CONFIG.exists()


def test_a_core_is_left_by_default(monkeypatch: pytest.MonkeyPatch):
    for cores, jobs in ((8, 7), (2, 1), (1, 1)):
        monkeypatch.setattr("os.sched_getaffinity", lambda _, cores=cores: set(range(cores)))
        assert default_jobs() == jobs
    used = []

    def drill(self: Drill, *, jobs: int, **_: Any) -> DrillReport:
        used.append(jobs)
        return DrillReport(self.seed, (SAFE,))

    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0, 1, 2})
    monkeypatch.setattr(Drill, "run", drill)
    for arguments in ((), ("--jobs", "5")):
        monkeypatch.setattr(sys, "argv", ["monstertruckd", "drill", "--config", str(DEMO), *arguments])
        with pytest.raises(SystemExit):
            main()
    assert used == [2, 5]
