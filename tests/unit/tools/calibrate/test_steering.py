"""Pulse maps and turn deficit from legs: what turns tell, what only the string tells, and stops."""

import asyncio
import math
from types import SimpleNamespace

import numpy as np
import pytest

from monstertruck_kinematics.chassis import Dimensions, TruckChassis, truck_chassis
from monstertruck_kinematics.polynomials import AxlePolynomials, SteeringPolynomials
from monstertruck_kinematics.truck import DriveTrain
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.body import TurnDeficitConfig
from monstertruckd.tools.calibrate import steering
from monstertruckd.tools.calibrate.steering import AxleTravel, SteeringWizard, _deficits, _rough, steered_senses
from monstertruckd.tools.calibrate.steering_model import Maps, SteeringModel, SteeringRun, half_widths
from monstertruckd.tools.calibrate.steps import Confirm, MoveRecord, MoveStep

CHASSIS = truck_chassis(Dimensions(DriveTrain()))
assert isinstance(CHASSIS, TruckChassis)
MODEL = SteeringModel(CHASSIS)
BELIEVED = Maps((1439.2, 1439.2), (-10.48, -10.48))
TRUE = Maps((1462.0, 1425.0), (-9.9, -11.0))


def leg(
    front: float,
    rear: float,
    metres: float,
    true: Maps = TRUE,
    rng: np.random.Generator | None = None,
    *,
    string: bool = False,
    stop: float = math.pi / 4,
) -> SteeringRun:
    """What a truck with the maps ``true`` does when it is commanded axle angles by the believed ones."""
    count = 16
    motor = np.full(count, CHASSIS.drivetrain.motor_angle(metres) / count)
    servos = CHASSIS.servos(front, rear)
    pulses = BELIEVED.pulses(0, np.full(count, servos[0])), BELIEVED.pulses(1, np.full(count, servos[1]))
    arm = np.clip(true.servo(0, pulses[0]), -stop, stop)
    real = SteeringRun(motor, (true.pulses(0, arm), pulses[1]), 0.0, 0.002)
    turn, aside = (float(value) for (value,) in MODEL.predict([real], true))
    if rng is not None:
        turn += float(rng.normal(0, math.hypot(0.002, 0.005 * turn, 0.004 * math.sqrt(abs(metres)))))
        aside += float(rng.normal(0, 0.008))
    return SteeringRun(motor, pulses, turn, math.hypot(0.002, 0.005 * turn), aside if string else None, 0.008)


def session(true: Maps, rng: np.random.Generator | None = None, *, string: bool = True) -> list[SteeringRun]:
    straights = [leg(0, 0, sign * 2.0, true, rng, string=string and sign > 0) for _ in range(3) for sign in (1, -1)]
    return [
        *straights,
        *(leg(sign * 0.35, 0, 5.0, true, rng) for sign in (1, -1)),
        *(leg(0, sign * 0.35, 5.0, true, rng) for sign in (1, -1)),
    ]


def test_without_noise_the_maps_are_found_exactly():
    fit = MODEL.fit(session(TRUE), BELIEVED, gain=10.0)
    assert fit.parameters[[0, 2]] == pytest.approx(TRUE.parameters[[0, 2]], abs=0.3)
    assert fit.parameters[[1, 3]] == pytest.approx(TRUE.parameters[[1, 3]], rel=2e-3)


def test_without_a_string_the_common_error_of_both_axles_is_not_seen_and_the_interval_says_so():
    crabbing = Maps((1439.2 + 25, 1439.2 + 25), (-10.48, -10.48))
    rng = np.random.default_rng(2)
    blind = MODEL.fit(session(crabbing, rng, string=False), BELIEVED)
    seeing = MODEL.fit(session(crabbing, rng, string=True), BELIEVED)
    errors = [np.abs(fit.parameters - crabbing.parameters)[[0, 2]].max() for fit in (blind, seeing)]
    halves = [half_widths(fit)[[0, 2]].max() for fit in (blind, seeing)]
    assert halves[0] > 2 * halves[1]
    assert (np.array(errors) < halves).all()
    assert halves[1] < 8


def short_arcs(true: Maps) -> tuple[list[SteeringRun], list[SteeringRun]]:
    """Those at the wizard's beginning."""
    arcs = [
        [leg(*(axle == 0) * np.array((s * 0.1, 0.0)) + (axle == 1) * np.array((0.0, s * 0.1)), d * 0.4, true)
         for s in (1, -1) for d in (1, -1)]
        for axle in (0, 1)
    ]  # fmt: skip
    return arcs[0], arcs[1]


@pytest.mark.parametrize("signs", [(1, 1), (-1, 1), (1, -1), (-1, -1)])
def test_directions_by_the_sense_of_the_turn(signs: tuple[int, int]):
    true = Maps(TRUE.centres, (TRUE.scales[0] * signs[0], TRUE.scales[1] * signs[1]))
    arcs = short_arcs(true)
    assert steered_senses(arcs) == signs  # type: ignore[arg-type]
    start = Maps(BELIEVED.centres, (BELIEVED.scales[0] * signs[0], BELIEVED.scales[1] * signs[1]))
    result = _rough(arcs, MODEL, start, None)  # type: ignore[arg-type]
    for axle, (name, sign) in enumerate(zip(("front", "rear"), signs, strict=True)):
        direction, centre = result.estimate(f"{name}_direction"), result.estimate(f"{name}_centre")
        assert direction is not None
        assert centre is not None
        assert direction.value == -sign
        assert centre.low is not None
        assert centre.high is not None
        assert centre.low < true.centres[axle] < centre.high


@pytest.mark.parametrize("turned_left", [True, False])
def test_where_both_axles_seem_to_steer_the_other_way_the_operator_sees_whether_it_is_the_compass(
    turned_left: bool, monkeypatch: pytest.MonkeyPatch
):
    asked: list[str] = []

    async def arcs(*_: object) -> tuple[list[SteeringRun], list[SteeringRun]]:
        return short_arcs(Maps(TRUE.centres, (-TRUE.scales[0], -TRUE.scales[1])))

    async def confirm(step: Confirm) -> bool:
        asked.append(step.name)
        return turned_left

    async def move(step: MoveStep) -> MoveRecord:
        asked.append(step.name)
        return MoveRecord()

    monkeypatch.setattr(SteeringWizard, "_arcs", staticmethod(arcs))
    monkeypatch.setattr(Maps, "of", lambda _: BELIEVED)
    context = SimpleNamespace(
        chassis=CHASSIS, config=None, confirm=confirm, expect=print, move=move, fit=lambda _, compute: compute()
    )
    wizard = SteeringWizard(rough=True)
    if turned_left:
        with pytest.raises(InputError, match="the compass reports the opposite"):
            asyncio.run(wizard(context))  # type: ignore[arg-type]
    else:
        result = asyncio.run(wizard(context))  # type: ignore[arg-type]
        assert [result.estimate(f"{name}_direction").value for name in ("front", "rear")] == [1, 1]  # type: ignore[union-attr]
    assert asked[-1] == "turned"


@pytest.mark.parametrize(
    "wizard",
    [SteeringWizard(), SteeringWizard(rough=True), SteeringWizard(strings=0, weaves=1)],
    ids=lambda it: it.moves,
)
def test_the_moves_that_are_announced_are_those_that_are_made(wizard: SteeringWizard, monkeypatch: pytest.MonkeyPatch):
    announced, made = [], []

    async def answer(step: object) -> float:
        return 0.0

    async def move(step: MoveStep) -> MoveRecord:
        made.append(step.name)
        return MoveRecord()

    def fit(what: str, _: object) -> object:
        return (
            (1, 1)
            if what == "directions"
            else SimpleNamespace(model_copy=lambda update: None, estimates=(), parameters=None)
        )

    def reach(axle: int, sign: int, *_: object) -> SimpleNamespace:
        return SimpleNamespace(axle=axle, sign=sign, servo=0.4)

    monkeypatch.setattr(Maps, "of", lambda _: BELIEVED)
    monkeypatch.setattr(Maps, "from_parameters", lambda _: BELIEVED)
    monkeypatch.setattr(SteeringRun, "of", lambda *_: None)
    monkeypatch.setattr(SteeringModel, "fit", lambda *_: SimpleNamespace(parameters=None))
    monkeypatch.setattr(steering.AxleTravel, "of", reach)
    monkeypatch.setattr(steering, "estimates", lambda _: ())
    monkeypatch.setattr(steering, "turns_plot", lambda *_: None)
    context = SimpleNamespace(
        plot=lambda _: None,
        chassis=CHASSIS, confirm=answer, ask=answer, expect=announced.append, move=move, fit=fit,
        config=SimpleNamespace(gate=SimpleNamespace(angle=0.4), devices=SimpleNamespace(compass=None)),
    )  # fmt: skip
    asyncio.run(wizard(context))  # type: ignore[arg-type]
    assert announced == [len(made)]


def test_wheels_that_do_not_steer_are_named():
    dead = ([leg(0, 0, d * 0.4, BELIEVED) for d in (1, -1, 1, -1)],) * 2
    with pytest.raises(InputError, match="front wheels: steering them turned the robot by"):
        steered_senses(dead)


def test_a_stop_is_found_and_kept_clear_of():
    far = [leg(0.43, 0, d * 0.6, TRUE, stop=math.radians(25)) for d in (1, -1)]
    reach = AxleTravel.of(0, 1, far, MODEL, TRUE)
    assert reach.stopped
    assert math.degrees(reach.servo) == pytest.approx(25, abs=0.3)
    travel, limit = reach.estimates("front", TRUE.centres[0], TRUE.scales[0], None)
    assert travel.low is not None
    assert (limit.name, limit.key) == ("front_min_us", "devices.steering.driver.front.min_us")
    assert limit.value == pytest.approx(TRUE.centres[0] + TRUE.scales[0] * 24, abs=4)


def test_a_free_axle_has_no_limit_and_a_limit_found_before_stays():
    far = [leg(0.3, 0, d * 0.6, TRUE) for d in (1, -1)]
    reach = AxleTravel.of(0, 1, far, MODEL, TRUE)
    assert not reach.stopped
    assert [e.name for e in reach.estimates("front", *TRUE.parameters[:2], None)] == ["front_left_travel"]
    stopped = AxleTravel.of(0, 1, [leg(0.43, 0, 0.6, TRUE, stop=math.radians(25))] * 2, MODEL, TRUE)
    earlier = _rough(([leg(0.1, 0, 0.4)] * 4, [leg(0, 0.1, 0.4)] * 4), MODEL, BELIEVED, None)
    limit = stopped.estimates("front", *TRUE.parameters[:2], None)[1].model_copy(
        update={"date": "2026-01-01T00:00:00Z"}
    )
    before = earlier.model_copy(update={"estimates": (limit,)})
    assert reach.estimates("front", *TRUE.parameters[:2], before)[1] == limit


# What the turns lack by another linkage

FULL = math.radians(36)
CIRCLES = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, -1), (-1, 1))
"""Front and rear servo, in shares of full lock."""


def another_linkage(rng: np.random.Generator) -> SteeringModel:
    """A truck whose linkage has other higher powers."""

    def other(coefficients: tuple[float, ...]) -> tuple[float, ...]:
        *higher, slope, start = coefficients
        return (*(float(k * rng.uniform(0, 2)) for k in higher), slope, start)

    front, rear = (
        AxlePolynomials(other(f), other(g))
        for f, g in (
            (axle.left_from_servo, axle.right_from_left)
            for axle in (SteeringPolynomials().front, SteeringPolynomials().rear)
        )
    )
    chassis = truck_chassis(Dimensions(DriveTrain(), polynomials=SteeringPolynomials(front, rear)))
    assert isinstance(chassis, TruckChassis)
    return SteeringModel(chassis)


def rolled(truck: SteeringModel, front: float, rear: float, metres: float, rng: np.random.Generator) -> SteeringRun:
    """What a truck with that linkage and the true maps does with its servos at these shares of full lock."""
    motor = np.full(16, CHASSIS.drivetrain.motor_angle(metres) / 16)
    pulses = TRUE.pulses(0, np.full(16, front * FULL)), TRUE.pulses(1, np.full(16, rear * FULL))
    (turn,), _ = truck.predict([SteeringRun(motor, pulses, 0.0, 0.002)], TRUE)
    sigma = math.hypot(0.002, 0.005 * turn)
    noise = float(rng.normal(0, math.hypot(sigma, 0.004 * math.sqrt(abs(metres)))))
    return SteeringRun(motor, pulses, float(turn) + noise, sigma)


@pytest.mark.parametrize("seed", range(4))
def test_circles_in_all_modes_make_the_curvature_right_up_to_full_lock(seed: int):
    rng = np.random.default_rng(seed)
    truck = another_linkage(rng)
    arcs = [rolled(truck, 0.45 * f, 0.45 * r, d, rng) for f, r in CIRCLES[:4] for d in (1.0, -1.0)]
    turns = [rolled(truck, f, r, 5.0, rng) for f, r in CIRCLES]
    straights = [leg(0, 0, sign * 2.0, TRUE, rng, string=sign > 0) for _ in range(3) for sign in (1, -1)]
    fit = MODEL.fit([*arcs, *turns, *straights], BELIEVED)
    maps = Maps.from_parameters(fit.parameters)

    def curvature(model: SteeringModel, believed: Maps, servos: list[float]) -> float:
        return CHASSIS.bicycle.curvature(*model.axles(believed).angles(*servos))

    plain = []
    for sides in CIRCLES:
        for share in (0.3, 0.5, 0.75, 1.0):
            servos = [side * share * FULL for side in sides]
            expected = curvature(truck, Maps.from_parameters(TRUE.parameters), servos)
            read = [float(maps.servo(i, TRUE.pulses(i, np.array(servo)))) for i, servo in enumerate(servos)]
            assert curvature(MODEL, maps, read) == pytest.approx(expected, rel=0.02)
            plain.append(abs(curvature(MODEL, TRUE, servos) / expected - 1))
    assert max(plain) > 0.02, "without the deficit it is not"
    assert np.isfinite(half_widths(fit)).all()


def test_what_servos_shall_do_is_commanded_by_the_believed_maps():
    servos = (math.radians(30), math.radians(-25))
    front, rear = MODEL.commands(servos, TRUE, BELIEVED)
    sent = CHASSIS.servos(front, rear)
    arms = [float(TRUE.servo(i, BELIEVED.pulses(i, np.array(servo)))) for i, servo in enumerate(sent)]
    assert arms == pytest.approx(servos, abs=1e-6)


def test_every_coefficient_is_saved_with_its_interval():
    fit = MODEL.fit(session(TRUE), BELIEVED)
    estimates = _deficits(Maps.from_parameters(fit.parameters), half_widths(fit)[4:], 10, "noise")
    assert [e.key for e in estimates] == [f"body.turn_deficit.{name}" for name in TurnDeficitConfig.model_fields]
    assert all(e.low is not None and e.high is not None and e.low < 0 < e.high for e in estimates)
