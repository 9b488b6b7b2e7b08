"""Code shared by all scanner drivers."""
