"""Calibration wizards: keys that each may set, and how long its result holds."""

from monstertruckd.config.wizards import WIZARDS, WizardKind
from pages.markdown import Page, join, prose, table


def page() -> Page:
    """Return the page, from the wizards' table."""
    text = join(
        "# Calibration wizards",
        "Values of the configuration that each wizard measures, and how long its result holds. "
        "How to use them: [calibration](calibration.md).",
        *(_section(wizard) for wizard in WIZARDS.values()),
    )
    return Page("wizards.md", "Calibration wizards", text)


def _section(wizard: WizardKind) -> str:
    life = wizard.lifetime
    distance = "" if life.metres is None else f" or {life.metres / 1000:g} km"
    topics = ", ".join(f"`{topic}`" for topic in life.topics)
    return join(
        f"## {wizard.name}",
        prose(wizard.doc),
        f"Holds for {life.days} days{distance}; then {topics} are `degraded`.",
        table(("value",), [(f"`{key}`",) for key in wizard.keys]),
    ).rstrip()
