"""Parts of ``benchmarks/slam.py``: each adds figures and goals of its own."""
