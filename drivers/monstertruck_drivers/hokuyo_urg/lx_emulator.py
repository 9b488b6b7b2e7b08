"""Emulated UST or UTM: SCIP 2.2 over a network socket.

Unlike the URG-04LX, it has neither SCIP 1.1 nor a baud rate. It adds scans with intensities, a state (``%ST``), a
partial reset (``RT``) and a reboot (``RB``). The specification leaves open whether a stream ends with its connection;
here it continues.
"""

import math

import numpy as np
from numpy.typing import NDArray

from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.emulation import BeamSource, EmulatorSetup
from monstertruck_drivers.hokuyo_urg.config import HokuyoLxConfig
from monstertruck_drivers.hokuyo_urg.emulator import Handler, HokuyoEmulator, ScanOrder
from monstertruck_drivers.hokuyo_urg.models import LX, ScannerModel
from monstertruck_drivers.hokuyo_urg.protocol import build_reply, line_sum
from monstertruck_runtime.clock import Clock


class BeamRanges:
    """``RangeSource`` for a scanner of any geometry.

    Args:
        source: source of single-beam ranges.
        model: geometry and error values.
    """

    def __init__(self, source: BeamSource, model: ScannerModel) -> None:
        steps = np.arange(model.greatest_step + 1)
        self._source, self._model = source, model
        self._bearings = (steps - model.front_step) * math.tau / model.steps_per_turn
        self._after = (steps * (model.period / model.steps_per_turn)).astype(np.int64)

    def scan(self, time_ns: int) -> NDArray[np.int32]:
        """Values of the revolution that starts at ``time_ns`` (mm or errors), shape (greatest step + 1,)."""
        model = self._model
        ranges = self._source.beams(self._bearings, time_ns + self._after, model.ranges)
        values = np.where(np.isinf(ranges), model.unreturned, np.where(np.isnan(ranges), model.failed, 0))
        measured = np.isfinite(ranges)
        values[measured] = np.rint(ranges[measured] * 1000)
        return values.astype(np.int32)


class LxEmulator(HokuyoEmulator):
    """Emulated UST or UTM.

    Faults (``inject``): ``unstable N`` (status 0M instead of the next N scans), and the faults of the URG-04LX.

    Args:
        clock: world time.
        source: range source.
        model: scanner model.
        seed: jitter seed.
        options: see ``HokuyoEmulator``.
    """

    def __init__(
        self, clock: Clock, source: BeamSource, model: ScannerModel, *, seed: int = 0, **options: float
    ) -> None:
        self._rebooting = False
        super().__init__(
            clock,
            BeamRanges(source, model),
            seed=seed,
            model=model,
            state="scip2",
            serial="H1614934",
            firmware="2.23.0000",
            **options,  # type: ignore[arg-type]
        )
        self.faults.add({"unstable N": 0})

    def _send_scan(self, end: DeviceEnd, order: ScanOrder, begin: int) -> None:
        if self.faults.strikes("unstable"):
            end.write(build_reply(order.echo, "0M"))
        else:
            super()._send_scan(end, order, begin)

    def _handlers(self) -> dict[str, Handler]:
        known = super()._handlers()
        for command in ("SS", "CR", "GS", "MS"):
            del known[command]
        return known | {
            "GE": self._single,
            "ME": self._multi,
            "%S": self._state_code,
            "RT": self._partial_reset,
            "RB": self._reboot,
        }

    def _state_code(self, text: str, _tag: str) -> tuple[str, list[bytes]]:
        if text != "%ST":
            return "0E", []
        state = "002" if self._adjusting else "004" if self._order is not None else "003" if self._laser else "000"
        return "00", [state.encode() + bytes((line_sum(state.encode()),))]

    def _partial_reset(self, text: str, tag: str) -> tuple[str, list[bytes]]:
        return self._rs(text, tag)

    def _reboot(self, _text: str, _tag: str) -> tuple[str, list[bytes]]:
        """Reboot on the second of two consecutive requests."""
        if not self._rebooting:
            self._rebooting = True
            return "01", []
        self._rebooting = False
        self.power_cycle()
        return "00", []


def emulated(setup: EmulatorSetup) -> LxEmulator:
    """Create a simulated robot's lidar."""
    settings = setup.settings if isinstance(setup.settings, HokuyoLxConfig) else HokuyoLxConfig()
    return LxEmulator(setup.clock, setup.room, LX[settings.model], seed=setup.seed)
