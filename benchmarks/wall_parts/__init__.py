"""Parts of the benchmark of wall following."""
