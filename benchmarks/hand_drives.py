"""Random drives by hand in both directions and four worlds; contacts are judged by the simulated world alone.

    python benchmarks/hand_drives.py [--count 200] [--seed 1] [--confirm 0.0] [--scans-alone]
                                     [--worlds loop rooms ...] [--minutes M]

Each drive lasts a minute and begins at a random place, the truck put down by hand. The operator asks for a random speed
forward or in reverse, with a random steering mode and angle, and changes all of them every 0.5 to 4 s, whatever is in
the way; one whose truck has been kept standing for 1 s asks for the other direction. With a share of --confirm of these
motions the operator holds the second action that lets the truck drive into unseen ground; contacts then are counted
apart, with the time until the gate moves the truck away from the obstacle. A contact that the gate does not notice
while the operator goes on, or from which it does not back off, is counted as unnoticed.
With --scans-alone no motor current shows a contact, as of a drive that measures none.

Drives are kept in ``runs/hand_drives.jsonl``, so that a run that ended early (``--minutes``) goes on where it was; one
of other sources starts again.

A contact is one of the world's own footprint with its walls, whatever the gate sees. That they are avoided must not be
bought by standing still: the distance travelled and the share of the time that the truck was kept standing are printed.
"""

import argparse
import json
import math
import random
import sys
from collections import Counter, defaultdict
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from hashlib import blake2s
from time import perf_counter

import numpy as np

from benchmarks import ROOT
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import InputError, RequestRefusedError
from monstertruck_runtime.mailbox import latest
from monstertruck_runtime.map_files import FREE
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveRequest, Order, Role
from monstertruck_schemas.state import GateState
from monstertruck_sim.world.built_in import BUILT_IN
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

WORLDS = ("loop", "rooms", "corridor_maze", "hall")
MODES = {"straight": (0, 0), "front": (1, 0), "rear": (0, 1), "counter": (1, -1), "parallel": (1, 1)}
"""Signs of the axle angles."""
ANGLE = 0.436
"""Greatest angle asked for, rad."""
SPEEDS = (0.03, 0.25)
"""Speeds asked for, m/s: up to more than the gate allows."""
CHANGES = (0.5, 4.0)
"""Seconds between two changes of the operator's mind."""
GIVES_UP = 1.0
"""Seconds of standing after which the operator asks for the other direction."""
PERIOD = 0.05
"""Seconds between two requests."""
DRIVE = 60.0
"""Seconds of a drive."""
NOTICED = 0.3
"""Seconds within which a contact has to be noticed."""
NOTICED_BY_SCANS = 0.5
"""The same where scans alone show it."""
BACKED_WITHIN = 2.5
"""Seconds after which the truck has backed off, if the operator goes on for so long."""
BACKED = 0.02
"""Distance from the place of a contact, m."""
OUTPUT = ROOT / "runs" / "hand_drives.jsonl"
SOURCES = ("monstertruckd", "drivers", "planners", "schemas", "configs", "benchmarks/hand_drives.py")
"""A drive is kept for as long as these stay as they are."""


Place = tuple[str, int]
"""World, and number of the drive in it."""


@dataclass
class Drive:
    """Record of one drive."""

    world: str
    number: int
    within: float = NOTICED
    """Seconds within which the gate has to notice a contact."""
    forward: float = 0.0
    """Distance travelled (m)."""
    reverse: float = 0.0
    contacts: list[str] = field(default_factory=list)
    confirmed: list[float] = field(default_factory=list)
    """Contacts during a confirmed drive that the gate noticed: seconds until it gave the reason."""
    unnoticed: list[str] = field(default_factory=list)
    """Others, for as long as the operator asked for the same motion."""
    backed: list[float] = field(default_factory=list)
    """Distance (m) that the gate then backed off while the operator asked for the same motion."""
    kept: float = 0.0
    """Seconds for which motion was asked for and the truck was kept standing."""
    reasons: Counter[str] = field(default_factory=Counter)
    """Ticks of 50 ms with each reason, by the direction asked for, while it was kept standing."""


@dataclass
class _Touch:
    """A contact during a confirmed drive."""

    at: int
    """When, ns."""
    why: str
    place: tuple[float, float]
    noticed: float | None = None
    """S after it."""
    away: float = 0.0
    """m."""

    def look(self, now: int, state: GateState, place: tuple[float, float]) -> None:
        """Note whether the gate reports the contact, and the distance of the truck from its place."""
        if self.noticed is None and Reason.CONTACT in state.reasons:
            self.noticed = (now - self.at) / SECOND
        self.away = max(self.away, math.dist(place, self.place))


def end_touch(touched: _Touch | None, now: int, out: Drive) -> None:
    """End a contact when the operator changes the motion or the drive ends; short contacts do not count."""
    if touched is None:
        return
    lasted = (now - touched.at) / SECOND
    if touched.noticed is not None:
        out.confirmed.append(touched.noticed)
        if lasted > BACKED_WITHIN:
            out.backed.append(touched.away)
    elif lasted > out.within:
        out.unnoticed.append(f"{touched.why}, {lasted:.2f} s")


def truck(world: str, seed: int, *, scans_alone: bool = False) -> SimulatedTruckConfig:
    """Return the emulated truck without planners; ``scans_alone``: the gate reads no current for contacts."""
    config = load_config(ROOT / "configs" / "demo.yaml", SimulatedTruckConfig)[0]
    config = config.model_copy(update={"recorder": None, "tracker": None, "path": None, "map": None})
    gate = {"contact": {"rise": 10.0, "rolling": 2.0}} if scans_alone else {}
    return with_overlay(config, {"sim": {"seed": seed, "world": {"map": world}}, "gate": gate})


async def put(rig: VirtualRig, clock: VirtualClock, rng: random.Random) -> None:
    """Carry the truck to a random free place."""
    known = BUILT_IN[rig.config.sim.world.map]().map
    rows, columns = np.nonzero(known.cells == FREE)
    while True:
        cell = rng.randrange(len(rows))
        x, y = known.origin[0] + columns[cell] * known.resolution, known.origin[1] + rows[cell] * known.resolution
        try:
            rig.world.carry(clock.now(), (float(x), float(y), rng.uniform(-math.pi, math.pi)))
        except InputError:
            continue
        return


async def drive(
    rig: VirtualRig, clock: VirtualClock, hand: LocalOperator, rng: random.Random, confirm: float, out: Drive
) -> None:
    """Drive for a minute and count the results."""
    gate = rig.bus.subscribe(topics.GATE, latest())
    change, speed, front, rear, unseen, name, stood = 0, 0.0, 0.0, 0.0, False, "", 0.0
    end = clock.now() + round(DRIVE * SECOND)
    touched: _Touch | None = None
    last = rig.world.truth(clock.now())
    stuck = last.stuck
    while clock.now() < end:
        now = clock.now()
        if now >= change or stood >= GIVES_UP:
            end_touch(touched, now, out)
            touched = None
            name, (of_front, of_rear) = rng.choice(list(MODES.items()))
            angle = rng.uniform(-ANGLE, ANGLE)
            sign = rng.choice((-1, 1)) if stood < GIVES_UP else -math.copysign(1.0, speed)
            speed, stood = sign * rng.uniform(*SPEEDS), 0.0
            front, rear = angle * of_front, angle * of_rear
            unseen = rng.random() < confirm
            change = now + round(rng.uniform(*CHANGES) * SECOND)
        state = gate.latest
        if state is not None and not state.mode.active:
            try:
                await hand.order(Order.ARM)
            except RequestRefusedError as refused:
                out.reasons[f"not armed: {refused.refusal}"] += 1
        request = DriveRequest(**await hand.header(0.25), speed=speed, front=front, rear=rear, unseen=unseen)
        rig.bus.inject(topics.REQ_DRIVE, request)
        await clock.sleep_until(now + round(PERIOD * SECOND))
        true = rig.world.truth(clock.now())
        way = math.dist((true.x, true.y), (last.x, last.y))
        if true.v >= 0:
            out.forward += way
        else:
            out.reverse += way
        state = gate.latest
        if state is not None and way < 0.005 * PERIOD:
            out.kept += PERIOD
            stood += PERIOD
            direction = "forward" if speed > 0 else "in reverse"
            out.reasons.update(f"{direction}: {reason}" for reason in (state.reasons or ("no reason",)))
        else:
            stood = 0.0
        if true.stuck and not stuck:
            why = f"{out.world} {out.number}: {name} at {speed:.2f} m/s, truly {last.v:.3f}"
            backs_off = state is not None and Reason.CONTACT in state.reasons
            if touched is None and not unseen:
                out.contacts.append(why)
            elif touched is None and not backs_off:
                touched = _Touch(clock.now(), why, (true.x, true.y))
        if touched is not None and state is not None:
            touched.look(clock.now(), state, (true.x, true.y))
        stuck, last = true.stuck, true
    end_touch(touched, clock.now(), out)
    rig.bus.inject(topics.REQ_DRIVE, DriveRequest(**await hand.header(0.25), speed=0.0, front=0.0, rear=0.0))


def driven(world: str, number: int, seed: int, confirm: float, scans_alone: bool) -> Drive:
    """Run one drive with a separate truck and daemon."""

    async def main(clock: VirtualClock) -> Drive:
        out = Drive(world, number, NOTICED_BY_SCANS if scans_alone else NOTICED)
        rng = random.Random(f"{seed} {world} {number}")
        rig = VirtualRig(truck(world, seed + number, scans_alone=scans_alone), clock)
        async with rig.running():
            await clock.sleep(3.0)
            await put(rig, clock, rng)
            await clock.sleep(1.0)
            await drive(rig, clock, LocalOperator(rig.daemon, clock, "hand", Role.GAMEPAD), rng, confirm, out)
        return out

    return run_virtual(main, start=SECOND)


def places(worlds: Iterable[str], count: int) -> Iterable[Place]:
    """Yield all drives, evenly over the worlds at any time."""
    worlds = tuple(worlds)
    return ((worlds[index % len(worlds)], index // len(worlds)) for index in range(count))


def digest(options: argparse.Namespace) -> str:
    """Return a name for drives with these options and the present sources."""
    made = blake2s(repr((options.seed, options.confirm, options.scans_alone)).encode(), digest_size=10)
    for place in map(ROOT.joinpath, SOURCES):
        files = sorted(place.rglob("*")) if place.is_dir() else [place]
        for file in (file for file in files if file.suffix in (".py", ".yaml", ".csv", ".png")):
            made.update(file.read_bytes())
    return made.hexdigest()


def kept(name: str) -> dict[Place, Drive]:
    """Drives of earlier runs with this digest."""
    lines = OUTPUT.read_text(encoding="utf-8").splitlines() if OUTPUT.exists() else []
    entries = [entry for entry in map(json.loads, lines) if entry.pop("digest") == name]
    return {(e["world"], e["number"]): Drive(**{**e, "reasons": Counter(e["reasons"])}) for e in entries}


def drives(options: argparse.Namespace) -> list[Drive]:
    """Run all drives that the time allows; return them with those of earlier runs."""
    end, name = perf_counter() + 60 * options.minutes, digest(options)
    found, every = kept(name), list(places(options.worlds, options.count))
    todo = [place for place in every if place not in found]
    OUTPUT.parent.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(options.jobs) as pool, OUTPUT.open("a", encoding="utf-8") as out:
        while todo and perf_counter() < end:
            some, todo = todo[: options.jobs], todo[options.jobs :]
            common = options.seed, options.confirm, options.scans_alone
            running = [pool.submit(driven, *place, *common) for place in some]
            for place, done in zip(some, running, strict=True):
                found[place] = done.result()
                print(json.dumps({"digest": name, **vars(found[place])}), file=out, flush=True)
    return [found[place] for place in every if place in found]


def main() -> int:
    """Drive; 0: no contact without confirmation."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--confirm", type=float, default=0.0)
    parser.add_argument("--scans-alone", action="store_true", help="no motor current shows a contact")
    parser.add_argument("--worlds", nargs="+", default=WORLDS, choices=sorted(BUILT_IN))
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=math.inf, help="begin no drive after this time")
    arguments = parser.parse_args()
    began = perf_counter()
    done = drives(arguments)
    print("| world | drives | forward m | reverse m | kept standing | contacts | confirmed contacts |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    by_world: dict[str, list[Drive]] = defaultdict(list)
    for one in done:
        by_world[one.world].append(one)
    for world, ones in by_world.items():
        kept = sum(one.kept for one in ones) / (len(ones) * DRIVE)
        print(
            f"| {world} | {len(ones)} | {sum(o.forward for o in ones):.1f} | {sum(o.reverse for o in ones):.1f} | "
            f"{kept:.0%} | {sum(len(o.contacts) for o in ones)} | {sum(len(o.confirmed + o.unnoticed) for o in ones)} |"
        )
    for one in done:
        for contact in (*one.contacts, *(f"unnoticed: {why}" for why in one.unnoticed)):
            print(contact)
    reasons: Counter[str] = sum((one.reasons for one in done), Counter())
    print("kept standing by:", ", ".join(f"{name} {count * PERIOD:.0f} s" for name, count in reasons.most_common(8)))
    noticed = [seconds for one in done for seconds in one.confirmed]
    backed = [metres for one in done for metres in one.backed]
    figures = {
        "drives": len(done),
        "contacts": sum(len(one.contacts) for one in done),
        "forward_m": round(sum(one.forward for one in done), 1),
        "reverse_m": round(sum(one.reverse for one in done), 1),
        "kept_standing": round(sum(one.kept for one in done) / (len(done) * DRIVE), 3),
        "confirmed_contacts": len(noticed) + sum(len(one.unnoticed) for one in done),
        "unnoticed": sum(len(one.unnoticed) for one in done),
        "noticed_max_s": round(max(noticed), 2) if noticed else None,
        "backed_off_least_m": round(min(backed), 3) if backed else None,
        "real_s": round(perf_counter() - began, 1),
    }
    within = NOTICED_BY_SCANS if arguments.scans_alone else NOTICED
    goals = {"contacts": 0, "unnoticed": 0, "noticed_max_s": within, "backed_off_least_m": BACKED}
    met = figures["contacts"] == figures["unnoticed"] == 0
    met = met and max(noticed, default=0.0) <= within and min(backed, default=BACKED) >= BACKED
    print(json.dumps({"bench": "hand_drives", "figures": figures, "goals": goals, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
