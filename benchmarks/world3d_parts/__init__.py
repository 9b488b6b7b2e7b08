"""Parts of ``benchmarks/world3d.py`` that run the whole daemon on uneven ground."""
