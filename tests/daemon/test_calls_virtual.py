"""The remote calls of a robot with everything are those of the page on Zenoh."""

import re
from pathlib import Path

import pytest

from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import RequestRefusedError
from monstertruck_schemas.health import ServiceHealth, ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import AccessRole, ServiceName
from monstertruckd.bus.rpc import Handler, Rpc
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(120)]

ROOT = Path(__file__).resolve().parents[2]


def test_what_is_asked_of_a_service_that_failed_is_refused_for_that():
    """A goal was accepted, and nothing happened; of a mission it was "a bug"."""
    calls = {
        ServiceName.GOALS: ("goal", "goal_control"),
        ServiceName.EXPLORER: ("explore",),
        ServiceName.MISSIONS: ("mission",),
        ServiceName.BEHAVIOURS: ("behave",),
        ServiceName.POINTS: ("points",),
    }

    async def main(clock: VirtualClock) -> None:
        config, _ = load_config(ROOT / "configs" / "points.yaml", SimulatedTruckConfig)
        rig = VirtualRig(config.model_copy(update={"recorder": None, "blackbox": None}), clock)
        async with rig.running():
            await clock.sleep(0.05)
            for service, names in calls.items():
                failed = ServiceHealth(name=service, state=ServiceState.FAILED, since=0, detail="ended by itself")
                rig.daemon._board.report(failed)
                for name in names:
                    with pytest.raises(RequestRefusedError, match=f"^{service}: ended by itself$") as refused:
                        await rig.daemon.rpc.call(name, {})
                    assert refused.value.refusal is Reason.SERVICE_FAILED

    run_virtual(main, start=SECOND)


def test_the_page_on_zenoh_lists_every_call_with_its_role(monkeypatch: pytest.MonkeyPatch):
    served = {"topics": AccessRole.OBSERVER}  # by the bridge, which the virtual clock has not
    register = Rpc.register

    def note(rpc: Rpc, name: str, handler: Handler, role: AccessRole = AccessRole.PILOT, **more: bool) -> None:
        served[name] = role
        register(rpc, name, handler, role, **more)

    monkeypatch.setattr(Rpc, "register", note)

    async def main(clock: VirtualClock) -> None:
        config, _ = load_config(ROOT / "configs" / "points.yaml", SimulatedTruckConfig)
        async with VirtualRig(config.model_copy(update={"recorder": None, "blackbox": None}), clock).running():
            await clock.sleep(0.05)

    run_virtual(main, start=SECOND)
    page = (ROOT / "docs" / "zenoh.md").read_text(encoding="utf-8")
    table = re.findall(r"^\| (`.*?) \| (pilot|observer|engineer) \|", page, re.MULTILINE)
    listed = {name: AccessRole(role) for names, role in table for name in re.findall(r"`(\w+)`", names)}
    assert listed == served
