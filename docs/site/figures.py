"""Updates the measured figures in the pages from ``docs/figures``: ``python docs/site/figures.py``."""

from pages import figures

if __name__ == "__main__":
    for page in sorted(figures.DOCS.glob("*.md")):
        text = page.read_text(encoding="utf-8")
        if (new := figures.refreshed(text)) != text:
            page.write_text(new, encoding="utf-8")
