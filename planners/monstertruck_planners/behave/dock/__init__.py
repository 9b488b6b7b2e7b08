"""Docking by the tag of a dock: perceive, approach, charge, and retry."""
