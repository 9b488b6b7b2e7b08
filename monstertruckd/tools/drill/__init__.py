"""Drills: faults injected into the simulated truck while it drives, scripted or random, and judged."""
