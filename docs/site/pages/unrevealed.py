"""Faults that no second measure reveals, from the drill's table."""

from monstertruckd.tools.drill.unrevealed import UNREVEALED
from pages.markdown import Page, join, table


def page() -> Page:
    """Return the page."""
    rows = [(", ".join(f"`{each}`" for each in row.families), row.why, row.limit) for row in UNREVEALED]
    text = join(
        "# Faults that nothing reveals",
        "Families of faults that a [drill](drills.md) can make and no second measure reveals, "
        "with the limit that holds then.",
        table(("families", "why nothing reveals them", "limit"), rows),
    )
    return Page("unrevealed.md", "Faults that nothing reveals", text)
