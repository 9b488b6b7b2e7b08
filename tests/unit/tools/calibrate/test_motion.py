"""Moves of the wizards: what ends them early has its reason, and says what to do."""

from types import SimpleNamespace

import pytest

from monstertruck_runtime.clock import run_virtual
from monstertruck_runtime.errors import NoAnswerError, RequestRefusedError
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import GateMode
from monstertruckd.tools.calibrate import motion
from monstertruckd.tools.calibrate.steps import MoveStep

STEP = MoveStep("run", speed=0.2, front=0.0, rear=0.0, metres=1.0)


def stopped(*reasons: Reason, mode: GateMode = GateMode.DISARMED) -> RequestRefusedError:
    run = motion._Run(None, None, (), {})
    run.state = SimpleNamespace(reasons=reasons, mode=mode, holder=None)
    run._truck = SimpleNamespace(source="wizard")
    with pytest.raises(RequestRefusedError) as refused:
        run._check()
    return refused.value


def test_a_stop_has_the_reason_of_the_gate():
    assert stopped(Reason.DISARMED, Reason.OBSTACLE_STOP).refusal is Reason.OBSTACLE_STOP
    assert str(stopped(Reason.DISARMED)) == "stopped by the gate: the truck is disarmed"


def test_an_expired_lease_says_what_to_do():
    error = stopped(Reason.LEASE_EXPIRED)
    assert str(stopped(mode=GateMode.ARMED)) == str(error), "armed, and nobody drives: the lease is gone already"
    assert error.refusal is Reason.LEASE_EXPIRED
    assert str(error).startswith(
        "stopped by the gate: no fresh drive request within its lease; requests came too late:"
    )
    assert "repeat it; nothing was saved" in str(error)


def test_a_silent_device_says_what_to_do_once():
    error = stopped(Reason.DRIVE_STALE, Reason.SCAN_STALE)
    assert str(error).startswith(
        "stopped by the gate: no fresh drive feedback, no fresh lidar scan; a device was silent"
    )
    assert str(error).count("repeat the wizard") == 1
    assert ";" not in str(stopped(Reason.OBSTACLE_STOP))


@pytest.mark.parametrize(
    ("held", "kind", "said"),
    [
        (
            (Reason.OBSTACLE_STOP,),
            RequestRefusedError,
            "run: no progress for 3 s (obstacle within the stopping distance)",
        ),
        ((), NoAnswerError, "run: no progress for 3 s (no reason given)"),
    ],
)
def test_a_run_that_is_held_ends_by_what_holds_it(held: tuple[Reason, ...], kind: type[Exception], said: str):
    async def main(clock):
        mover = motion.Mover(None, clock, SimpleNamespace(drivetrain=None))
        record = SimpleNamespace(left=0, way=lambda _: 0.0)

        async def hold(*_: float) -> None:
            await clock.sleep(motion.PERIOD)

        run = SimpleNamespace(track=record, state=SimpleNamespace(reasons=held), hold=hold)
        await mover._drive(run, STEP, lambda _: None)

    with pytest.raises(kind) as ended:
        run_virtual(main)
    assert str(ended.value) == said
    assert getattr(ended.value, "refusal", Reason.TIMEOUT) is (held[0] if held else Reason.TIMEOUT)
