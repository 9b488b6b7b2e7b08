"""The whole daemon with its rendered webcam, 640 x 480 at 15 Hz: speed relative to real time."""

import time

from benchmarks.world3d_parts.terrain import CONFIGS, run
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas import topics
from monstertruck_schemas.req import Order
from monstertruckd.config.load import load_config
from monstertruckd.tools.drill.truck import DrillTruck
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay

RATE = 15
OVERLAY = {
    "recorder": None,
    "devices": {
        "camera": {
            "mount": {"x": 0.18, "z": 0.25},
            "driver": {"kind": "webcam", "width": 640, "height": 480, "rate": RATE},
        }
    },
    "sim": {"world": {"camera": {"rendered": True, "noise": 3.0}}},
}


def webcam(seconds: float = 10.0) -> dict[str, float]:
    """Return seconds of the world's clock per second of real time, and images per second of the former."""

    async def drive(truck: DrillTruck) -> tuple[float, int]:
        assert await truck.until(truck.drives, 15.0, Order.ARM)
        with truck.rig.bus.subscribe(topics.CAMERA, fifo(4096)) as pictures:
            begin = time.perf_counter()
            await truck.clock.sleep(seconds)
            return time.perf_counter() - begin, len([*pictures.drain()])

    config = with_overlay(load_config(CONFIGS / "full3d.yaml", SimulatedTruckConfig)[0], OVERLAY)
    taken, count = run(config, drive)
    return {"webcam_speed": seconds / taken, "webcam_pictures_per_s": count / seconds}


if __name__ == "__main__":
    for _name, _value in webcam().items():
        print(f"{_name:36} {_value:.4g}")
