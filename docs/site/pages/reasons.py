"""Reason reference: every reason of events, refusals and ends with its exit code, from the schemas."""

from monstertruck_schemas.reasons import Reason
from pages.markdown import Page, join, table


def page() -> Page:
    """Return the page."""
    rows = [(str(reason.exit_code), f"`{reason.value}`", reason.text) for reason in Reason]
    rows.sort(key=lambda row: int(row[0]))
    return Page(
        "reasons.md",
        "Reasons and exit codes",
        join(
            "# Reasons and exit codes",
            "Each code belongs to one reason, except 0, which all reasons of success share; it is never reassigned. "
            "`monstertruckd reasons` prints the same table. Remedies: [What to do when ...](what-to-do.md).",
            table(("code", "reason", "what"), rows),
        ),
    )
