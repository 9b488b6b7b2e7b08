"""Writes of the host that end half-way."""

from monstertruck_drivers.cable import MemoryPort
from monstertruck_runtime.clock import run_virtual
from monstertruck_sim.console import set_line_fault


def test_the_next_writes_end_half_way_and_single_bytes_do_not_count():
    async def main(clock):
        port = MemoryPort("x")
        port.plug()
        heard = []
        port.device.on_bytes = lambda to_device, data: heard.append(data)
        set_line_fault(port.device.faults, "short_writes", "2")
        link = await port.open()
        for data in (b"abcdef", b"g", b"hij", b"klm"):
            link.write(data)
        link.close()
        return heard

    assert run_virtual(main) == [b"abc", b"g", b"h", b"klm"]
