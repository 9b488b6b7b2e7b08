"""The recipe for the gains of ``wall_pd``, tried on a robot beside a wall."""

import asyncio
import math
from contextlib import contextmanager

import numpy as np
import pytest
from typer.testing import CliRunner

from monstertruck_planners.behave.wall.config import WallPdConfig
from monstertruck_planners.behave.wall.published import WallPd
from monstertruck_runtime import client
from monstertruck_runtime.errors import NoAnswerError, RequestRefusedError
from monstertruck_runtime.mailbox import Mailbox
from monstertruck_schemas.health import HealthTable, ServiceHealth, ServiceState
from monstertruck_schemas.plan import BehaviourState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import BehaviourOrder
from monstertruck_schemas.topics import BEHAVIOUR, GATE
from monstertruckd.tools.cli.main import app
from monstertruckd.tools.tune.recipe import RunVerdict, judged, recipe
from monstertruckd.tools.tune.runs import Tuning, draw, tune
from tests.bus_kit import gate_state
from tests.unit.planners.behave.wall_kit import Robot, drive

OVERSHOOTS = 0.6

WALL = [(-50.0, 0.35, 200.0, 0.35)]


class Client:
    """A robot with ideal wheels whose behaviour is run at once when it is started."""

    wild = None
    failed = False

    def __init__(self, outcome=Reason.DRIVING):
        self.outcome, self.number, self.running, self.wanted, self.armed = outcome, 0, "", 0.35, None
        self.held = False

    async def arm(self, *, hold=False):
        assert hold is not self.held, "once before the behaviour runs, and once it does"
        self.armed, self.held = True, hold

    async def disarm(self):
        self.armed = False

    @contextmanager
    def subscribe(self, topic, delivery):
        box = Mailbox(delivery)
        if topic is BEHAVIOUR:
            self.box = box
        elif topic is GATE:
            box.put(gate_state(1))
        elif self.failed:
            row = ServiceHealth(name="behaviours", state=ServiceState.FAILED, since=0, detail="ended by itself")
            box.put(HealthTable(stamp=0, received=0, seq=0, services=(row,)))
        yield box

    async def behave(self, order, behaviour="", settings=None, *, own=False):
        if order is BehaviourOrder.STOP:
            assert own, "nobody else's is stopped"
            self.running = ""
            return {}
        assert self.armed
        assert not self.running
        self.number, self.running = self.number + 1, behaviour
        robot = Robot(WALL, (0.0, 0.30 - self.wanted, 0.0), ahead=0.05)
        self.wanted = settings["distance"]
        head = {"stamp": 0, "received": 0, "seq": 0, "number": self.number, "behaviour": behaviour, "kind": "wall_pd"}
        config = WallPdConfig(offset=0.05, **settings)
        for i, step in enumerate(() if self.failed else drive(WallPd(config), robot, 9.0).steps):
            head |= {"running": self.outcome is Reason.DRIVING, "outcome": self.outcome, "elapsed": i * 0.1}
            values = dict(step.values)
            if (config.k_p, config.k_d) == self.wild:
                values["distance"] += 0.01 * i
            self.box.put(BehaviourState(**head, source="ann", phase=step.phase, travelled=0.0, values=values))
        return {"number": self.number}


async def rest():
    await asyncio.sleep(0)


def tuned(client, runs):
    return asyncio.run(tune(client, "wall_left", 0.3, Tuning(first=3.0), rest, runs.append))


def test_it_raises_p_until_it_overshoots_and_d_until_it_is_calm(tmp_path):
    runs = []
    client = Client()
    best = tuned(client, runs)
    assert client.armed is False
    overshot = next(i for i, run in enumerate(runs) if run.verdict.overshoot >= OVERSHOOTS)
    assert all(run.gains.k_d == 0.0 for run in runs[: overshot + 1])
    assert best is not None
    assert best.k_d > 0.0
    chosen = next(run for run in runs if run.gains == best)
    assert chosen.verdict.overshoot <= 0.5
    assert chosen.verdict.steady == min(run.verdict.steady for run in runs if run.verdict.overshoot <= 0.5)
    draw(runs, tmp_path / "runs.png")
    assert (tmp_path / "runs.png").stat().st_size > 5000


def test_a_run_in_which_the_robot_leaves_the_wall_is_broken_off_and_counts_as_overshooting():
    client, runs = Client(), []
    client.wild = 3.0, 0.0
    tuned(client, runs)
    assert runs[0].verdict.overshoot == math.inf
    assert len(runs[0].samples) < 25
    assert runs[1].gains.k_d > 0.0


def test_a_run_that_ends_early_ends_the_tuning_with_its_reason():
    client = Client(Reason.STUCK)
    with pytest.raises(RequestRefusedError) as caught:
        tuned(client, [])
    assert caught.value.refusal is Reason.STUCK
    assert not client.running
    assert client.armed is False


def test_nobody_waits_for_behaviours_whose_service_failed():
    client = Client()
    client.failed = True
    with pytest.raises(RequestRefusedError, match=r"^behaviours: ended by itself$") as caught:
        tuned(client, [])
    assert caught.value.refusal is Reason.SERVICE_FAILED
    assert client.armed is False


@pytest.mark.parametrize("lost", [NoAnswerError("no answer within 2.5 s"), asyncio.CancelledError()])
def test_a_robot_that_was_armed_without_saying_so_is_disarmed(lost):
    client = Client()

    async def arm(*, hold):
        client.armed = True
        raise lost

    client.arm = arm
    with pytest.raises(type(lost)):
        tuned(client, [])
    assert client.armed is False


def test_a_start_that_is_not_answered_is_taken_back():
    client, start = Client(), Client.behave

    async def behave(order, behaviour="", settings=None, *, own=False):
        await start(client, order, behaviour, settings, own=own)
        if order is BehaviourOrder.START:
            raise asyncio.CancelledError

    client.behave = behave
    with pytest.raises(asyncio.CancelledError):
        tuned(client, [])
    assert client.number == 1
    assert not client.running


def test_a_robot_that_refuses_to_be_armed_may_be_driven_by_somebody_else_and_is_left_alone():
    client = Client()

    async def arm(*, hold):
        raise RequestRefusedError(Reason.BUSY, "bob drives")

    client.arm = arm
    with pytest.raises(RequestRefusedError):
        tuned(client, [])
    assert client.armed is None


def test_it_gives_up_after_some_runs_without_calm_gains():
    trials, tried = recipe(3.0), []
    tried.append(next(trials))
    best = trials
    try:
        while True:
            tried.append(trials.send(RunVerdict(1.0, 0.02)))
    except StopIteration as end:
        best = end.value
    assert len(tried) == 16
    assert tried[-1].k_d > 0.0
    assert best is None


def test_overshoot_is_a_share_of_the_step_and_steady_the_end():
    times = np.arange(0.0, 8.0, 0.1)
    verdict = judged(list(0.05 * np.exp(-0.5 * times) * np.cos(2 * times)))
    assert verdict.overshoot == pytest.approx(0.5, abs=0.06)
    assert verdict.steady < 0.005
    with pytest.raises(ValueError, match="9 samples"):
        judged([0.0] * 9)


@pytest.mark.parametrize(
    ("name", "said"), [("runs.txt", "expected a name that ends with .png"), ("there.png", "Is a directory")]
)
def test_a_plot_that_cannot_be_written_is_refused_before_the_robot_drives(tmp_path, monkeypatch, name, said):
    monkeypatch.setattr(client, "TruckClient", None)  # nobody is asked
    (tmp_path / "there.png").mkdir()
    done = CliRunner().invoke(app, ["tune", "wall", "--plot", str(tmp_path / name)])
    assert done.exit_code == 3
    assert said in done.stderr
