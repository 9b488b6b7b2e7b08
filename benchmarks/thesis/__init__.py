"""Chapter 5 of the thesis: a module with ``run(options) -> Part`` for each experiment; run ``benchmarks.thesis``."""
