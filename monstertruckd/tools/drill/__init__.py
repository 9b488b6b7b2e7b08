"""Drills: random faults injected into the simulated truck while it drives, and judged."""
