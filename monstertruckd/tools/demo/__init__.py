"""The demo: an operator's lap on the emulated truck, on the wall clock or the virtual one."""
