"""Goals and behaviours that benchmarks run to their end on the virtual clock."""

import contextlib
from typing import Any

from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.clock import VirtualClock
from monstertruck_runtime.errors import RequestRefusedError
from monstertruck_runtime.mailbox import fifo
from monstertruck_runtime.ports import Subscription
from monstertruck_schemas.plan import BehaviourState, GoalPhase, GoalState
from monstertruck_schemas.req import BehaviourOrder
from monstertruck_schemas.state import GateState
from monstertruck_schemas.topics import BEHAVIOUR
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig


async def goal_end(
    number: int, operator: LocalOperator, states: Subscription[GoalState], gate: Subscription[GateState]
) -> str:
    """Arm the robot again after each stop that disarms it; returns the outcome of the goal."""
    while True:
        state = await states.next()
        if state.number == number and state.phase is GoalPhase.IDLE:
            return str(state.outcome.value)
        if gate.latest is not None and not gate.latest.mode.active:
            with contextlib.suppress(RequestRefusedError):
                await operator.arm()


async def behaviour_run(
    config: Any, name: str, clock: VirtualClock, *, settle: float, limit: float
) -> tuple[list[BehaviourState], Array]:
    """Run a behaviour of a robot to its end.

    Args:
        config: configuration of the simulated robot.
        name: name of the behaviour.
        clock: source of time.
        settle: time before the robot is armed, s.
        limit: maximum time of the behaviour, s.

    Returns:
        Its states, and the truth.
    """
    rig, seen = VirtualRig(config, clock), list[BehaviourState]()
    with rig.bus.subscribe(BEHAVIOUR, fifo(4096)) as states:
        async with rig.running():
            operator = LocalOperator(rig.daemon, clock)
            await clock.sleep(settle)
            await operator.arm()
            number = int((await operator.behave(BehaviourOrder.START, name))["number"])
            with contextlib.suppress(TimeoutError):
                async with clock.deadline(limit):
                    async for state in states:
                        seen += [state] if state.number == number else []
                        if seen and not seen[-1].running:
                            break
            await clock.sleep(1.0)
            return seen, rig.truth.array()
