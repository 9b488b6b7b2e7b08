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
            "Codes are never reassigned. All successes share 0, and a few related reasons share a code. "
            "`monstertruckd reasons` prints the same table. Remedies: [What to do when ...](what-to-do.md).",
            table(("code", "reason", "what"), rows),
        ),
    )
