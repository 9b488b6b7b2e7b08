"""Parts of ``benchmarks/usb_kernel.py``: the virtual machine, and the programs inside it."""
