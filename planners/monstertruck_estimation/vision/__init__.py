"""Computer vision; requires the extra ``vision``, which is loaded on first use."""
