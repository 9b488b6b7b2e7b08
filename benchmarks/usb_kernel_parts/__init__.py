"""Parts of ``benchmarks/usb_kernel.py``: the virtual machine, and what runs inside it."""
