"""The lidar's stabiliser in the whole daemon on a rocking truck, on the virtual clock; figures are the benchmark's."""

import math

import pytest

from benchmarks.stabiliser import GOAL_MAX, GOAL_RMS, OFF, ramp, tilts
from monstertruck_estimation.transforms import FrameTree
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import latest
from monstertruck_schemas import topics
from monstertruck_schemas.health import ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(120)]


def test_the_lidar_stays_level_on_a_rocking_truck():
    on, off = tilts(ramp(), 8.0), tilts(ramp(OFF), 4.0)
    print(f"on: {on['rms_deg']:.2f} deg RMS, {on['max_deg']:.2f} deg; off: {off['rms_deg']:.2f}, {off['max_deg']:.2f}")
    assert on["rms_deg"] < GOAL_RMS
    assert on["max_deg"] < GOAL_MAX
    assert off["rms_deg"] > 10 * GOAL_RMS
    # What the scans say of their tilt is true either way.
    assert max(on["stated_error_max_deg"], off["stated_error_max_deg"]) < 1.0


def test_the_joints_are_in_the_tree_of_frames():
    async def main(clock: VirtualClock) -> None:
        rig = VirtualRig(ramp(), clock)
        frames = rig.bus.subscribe(topics.TRANSFORMS, latest())
        joints = rig.bus.subscribe(topics.STABILISER, latest())
        async with rig.running():
            greatest = 0.0
            for _ in range(40):
                await clock.sleep(0.1)
                if clock.now() < 4 * SECOND:
                    continue
                assert frames.latest is not None
                assert joints.latest is not None
                tree = FrameTree(frames.latest.transforms)
                rows = {row.child: row for row in frames.latest.transforms}
                assert rows["lidar"].parent == "stabiliser"
                assert rows["stabiliser"].parent == "base"
                lidar = tree.lookup("base", "lidar")
                assert lidar.translation == pytest.approx((0.14, 0.0, 0.25))
                greatest = max(greatest, abs(2 * math.asin(lidar.rotation[1])))
            assert math.radians(12) < greatest < math.radians(18)

    run_virtual(main, start=SECOND)


def test_a_lidar_whose_joints_tell_nothing_is_not_trusted():
    """The 12 V rail fails: nobody knows where the lidar looks, so the truck stands."""

    async def main(clock: VirtualClock) -> None:
        rig = VirtualRig(ramp(), clock)
        gate = rig.bus.subscribe(topics.GATE, latest())
        scans = rig.bus.subscribe(topics.SCAN, latest())
        health = rig.bus.subscribe(topics.HEALTH, latest())

        def state() -> ServiceState | None:
            rows = health.latest.services if health.latest is not None else ()
            return next((row.state for row in rows if row.name == "stabiliser"), None)

        async with rig.running():
            await clock.sleep(3.0)
            assert gate.latest is not None
            assert Reason.SCAN_STALE not in gate.latest.reasons
            rig.context.device("stabiliser").command(["power", "off"])
            await clock.sleep(1.5)
            assert state() is not ServiceState.READY
            assert scans.latest is not None
            assert scans.latest.tilt == pytest.approx(math.pi / 2)
            assert Reason.SCAN_STALE in gate.latest.reasons
            rig.context.device("stabiliser").command(["power", "on"])
            await clock.sleep(2.5)
            assert state() is ServiceState.READY
            assert Reason.SCAN_STALE not in gate.latest.reasons

    run_virtual(main, start=SECOND)
