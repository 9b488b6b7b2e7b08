"""Computer vision: needs the extra ``vision``, and is loaded on use only."""
