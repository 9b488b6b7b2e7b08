"""Faults on the simulated truck, scored."""
