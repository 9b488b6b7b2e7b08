"""Mutants with the same behaviour as the source, so that no test can kill them, each with its reason."""

from typing import Final

GATE: Final = "monstertruckd/gate/"
DRIVE: Final = "drivers/monstertruck_drivers/epos/driver.py"
EXCHANGE: Final = "drivers/monstertruck_drivers/epos/exchange.py"
NANOSECOND: Final = "a nanosecond, at the very beginning of time"
TINY: Final = "a pace of a micrometre a second"
UNREAD: Final = "set before it is read"
ROUNDED: Final = "a difference of rounded distances is never exactly 3 cm"
CACHE: Final = "the cached value is computed once more"

EQUIVALENTS: Final[dict[str, str]] = {
    f"{GATE}arbitration.py::Sources.__init__: 0 -> (1)": "nobody drives before an ARM order, which sets it",
    f"{GATE}config.py::weakened: 1 -> (2)": "a sign: only whether it is positive counts",
    f"{GATE}obstacles.py::ObstacleGuard.__init__: 0 -> (1)": NANOSECOND,
    f"{GATE}obstacles.py::ObstacleGuard._update_unseen: 0 -> (1)": NANOSECOND,
    f"{GATE}obstacles.py::ObstacleGuard.delay: 0 -> (1)": NANOSECOND,
    f"{GATE}obstacles.py::ObstacleGuard.free_distance: self._checked != rounded -> True": CACHE,
    f"{GATE}obstacles.py::ObstacleGuard.free_distance: self._checked = rounded -> pass": CACHE,
    f"{GATE}obstacles.py::ObstacleGuard.__init__: self._free = math.inf -> self._free = None": CACHE,
    f"{GATE}limiter.py::CommandLimiter.aim: pace >= LEAST -> ((pace) >= (LEAST) / 1.1)": TINY,
    f"{GATE}limiter.py::CommandLimiter.aim: pace >= LEAST -> ((pace) >= (LEAST) * 1.1)": TINY,
    f"{GATE}visibility.py::Visibility.observe: geometry != self._geometry -> True": CACHE,
    f"{GATE}visibility.py::Visibility.__init__: 0 -> (1)": UNREAD,
    f"{GATE}visibility.py::_sector: bearings + math.pi -> ((bearings) - (math.pi))": "a whole turn, modulo turns",
    f"{GATE}obstacles.py::module: 1e-6 -> (2e-06)": "a micrometre",
    f"{GATE}obstacles.py::ObstacleGuard._swept: 1 -> (2)": "a length that follows from the others",
    f"{GATE}scan_memory.py::spaced: 1.0 -> (2.0)": "less than the first number of a step",
    f"{GATE}scan_memory.py::ScanMemory.forget: 0.0 -> (1.0)": "poses and distances are compared by their differences",
    f"{GATE}scan_memory.py::ScanMemory.seen: beyond_x < DRIFT -> (beyond_x <= DRIFT)": ROUNDED,
    f"{GATE}scan_memory.py::ScanMemory.seen: beyond_y < DRIFT -> (beyond_y <= DRIFT)": ROUNDED,
    f"{GATE}scan_memory.py::ScanMemory.points: beams >= edge -> (beams > edge)": "0.1 rad are 16.3 beams of the lidar",
    f"{GATE}motion.py::Motion.servos: self._servos[0] != self.angles -> True": CACHE,
    f"{GATE}motion.py::Motion.shaft_speeds: self._shafts[0] != command -> True": CACHE,
    f"{GATE}motion.py::Motion.shaft_speeds: 0 -> (1)": CACHE,
    f"{GATE}motion.py::Motion.servos: 0 -> (1)": CACHE,
    f"{GATE}motion.py::Motion.progress: 1.0 -> (2.0)": "divides zero: no shaft turns for the motion",
    f"{GATE}limiter.py::CommandLimiter.advance: aim.pace <= allowed -> (aim.pace < allowed)": "scaled by 1",
    f"{GATE}approach.py::Approach.limits: allowed < (2 * crawl if self.blocked else crawl) -> "
    "(allowed <= (2 * crawl if self.blocked else crawl))": "a rounded speed",
    f"{GATE}obstacles.py::ObstacleGuard.observe: np.hypot(points[:, 0], points[:, 1]) < self._near -> "
    "(np.hypot(points[:, 0], points[:, 1]) <= self._near)": "a rounded distance",
    f"{GATE}limiter.py::CommandLimiter.limit: "
    "aim.pace > aim.max_pace * (1 + ROUNDING) -> (aim.pace >= (aim.max_pace * (1 + ROUNDING)))": "a rounded product",
    f"{GATE}motion.py::Motion._reached: "
    "max(abs(asked - got) for asked, got in zip(angles, reached, strict=True)) > SATURATED -> "
    "(max(abs(asked - got) for asked, got in zip(angles, reached, strict=True)) >= SATURATED)": "a rounded difference",
    f"{GATE}core.py::Gate.__init__: 0 -> (1)": NANOSECOND,
    f"{GATE}samples.py::Samples.speed: self._speed is None or self._speed[0] != now -> True": CACHE,
    f"{GATE}samples.py::Samples.speed: self._speed[0] != now -> True": CACHE,
    f"{GATE}samples.py::Samples.speed: 0 -> (1)": CACHE,
    f"{GATE}following.py::ShaftComparison.observe: "
    "measured * math.copysign(1.0, commanded) -> ((measured) / (math.copysign(1.0, commanded)))": "a sign: 1 or -1",
    f"{GATE}samples.py::Samples._fresh_drives: "
    "d is not None and self._fresh(d, limit, now, Reason.DRIVE_STALE) -> "
    "((self._fresh(d, limit, now, Reason.DRIVE_STALE)))": "what was never measured is not fresh either",
    f"{GATE}samples.py::Samples._fresh: 1 -> (2)": "both are before all time",
    f"{GATE}following.py::TurnComparison._begin: 0.0 -> (1.0)": "turns are compared by their differences",
    f"{GATE}following.py::TurnComparison.__init__: 0.0 -> (1.0)": UNREAD,
    f"{GATE}service.py::GateService._publish: (output.mode is GateMode.ESTOPPED) != self._latched -> True": (
        "what is stored is compared once more with the mode"
    ),
    f"{GATE}service.py::GateService._tick_for_ever: 0 -> (1)": "a tick a nanosecond earlier",
    f"{DRIVE}::Odometer.update: raw - before + 2**31 -> ((raw - before) - (2**31))": "the same modulo 2**32",
    f"{DRIVE}::_DriveSession._idle: 0 -> (1)": "a nanosecond less to wait",
    f"{DRIVE}::_DriveSession.__init__: 0 -> (1)": NANOSECOND,
    f"{DRIVE}::_DriveSession.__init__: 1 -> (2)": UNREAD,
    f"{DRIVE}::_DriveSession._cycle: "
    "await self._read(od.CURRENT) / 1000 * self._sign -> ((await self._read(od.CURRENT) / 1000) / (self._sign))": (
        "a sign: 1 or -1"
    ),
    f"{EXCHANGE}::Exchanger.__init__: 0 -> (1)": UNREAD,
    f"{EXCHANGE}::Exchanger.settle: 0 -> (1)": "a nanosecond less to wait",
    f"{EXCHANGE}::Exchanger.settle: (left := min(self.quiet_until, limit) - self._clock.now()) > 0 -> "
    "((left := min(self.quiet_until, limit) - self._clock.now()) >= 0)": "a wait of no time",
    f"{EXCHANGE}::Exchanger.__init__: self.began = 0 -> pass": UNREAD,
    f"{EXCHANGE}::Exchanger.__init__: self.ended = 0 -> pass": UNREAD,
    f"{GATE}latch.py::EstopLatch.__init__: 8 -> (9)": "the length of a name",
    f"{GATE}latch.py::Mark.engaged: 2 -> (3)": "any second byte is damage",
}
"""By ``Mutant.key``."""
