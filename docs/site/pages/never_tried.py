"""What was never tried on hardware: those sections of all pages in one place."""

import re
from collections.abc import Mapping

from markdown.extensions.toc import slugify

from pages.markdown import Page, join

SECTION = re.compile(r"^## (Never tried[^\n]*)\n(.*?)(?=^## |\Z)", re.DOTALL | re.MULTILINE)


def page(texts: Mapping[str, tuple[str, str]]) -> Page:
    """The page.

    Args:
        texts: title and Markdown of the pages written by hand, by place; links in them are relative to the root.
    """
    parts = [
        "# Hardware never tried",
        "What the author's truck has not confirmed yet, from all pages: read it before you trust a figure or a device.",
    ]
    for uri, (title, text) in texts.items():
        for heading, section in SECTION.findall(text):
            own = "## All of it" if uri == "index.md" else f"## {title}"
            parts += [own, section.strip(), f"From [{title}: {heading.lower()}]({uri}#{slugify(heading, '-')})."]
    return Page("never-tried.md", "Hardware never tried", join(*parts))
