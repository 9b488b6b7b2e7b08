"""Parts of the benchmark of the booted service."""
