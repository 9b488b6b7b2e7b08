"""Parts of the benchmark of missions."""
