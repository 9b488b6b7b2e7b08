"""Chapter 5 of the thesis: an experiment a module with ``run(options) -> Part``; ``python -m benchmarks.thesis``."""
