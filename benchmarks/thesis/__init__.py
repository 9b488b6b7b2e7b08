"""Chapter 5 of the thesis: a module with ``run(options) -> Part`` for each experiment; ``python -m benchmarks.thesis``."""
