"""The demo: a lap of the emulated truck, on the wall clock or the virtual clock."""
