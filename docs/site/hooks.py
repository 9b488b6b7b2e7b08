"""MkDocs hooks: pages made from the code, pages that live outside ``docs/``, links to files of the repository."""

import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files, InclusionLevel
from pages import (
    api,
    benchmarks,
    commands,
    configuration,
    devices,
    figures,
    never_tried,
    reasons,
    source,
    symptoms,
    topics,
    unrevealed,
    wizards,
)
from pages.markdown import Page, join

ROOT = Path(__file__).resolve().parents[2]
OUTSIDE = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "SECURITY.md": "security.md",
    "CODE_OF_CONDUCT.md": "conduct.md",
}
"""Pages of the repository's top level, and their places on the site."""
ASSETS = ("style.css", "iframe-worker.js")
UNSEARCHED = ("changelog", "files/")
LINK = re.compile(r"(?<=\]\()(?![a-z]+:|#)([^)#\s]+)(#[^)\s]*)?(?=\))")
LANGUAGES = {".yaml": "yaml", ".py": "python", ".sh": "bash", ".csv": "text", ".rules": "text"}

generated: list[Page] = []


def on_config(config: Any) -> Any:
    """Make the pages, and put them into the navigation where it says ``folder/*``."""
    written = {OUTSIDE[name]: (ROOT / name).read_text() for name in OUTSIDE}
    for file in sorted((ROOT / "docs").rglob("*.md")):
        if "site" not in file.relative_to(ROOT / "docs").parts:
            written[file.relative_to(ROOT / "docs").as_posix()] = file.read_text()
    texts = {uri: (_title(text), _to_site(text, uri)) for uri, text in written.items() if uri != "changelog.md"}
    generated[:] = [
        *devices.pages(),
        *commands.pages(texts),
        *topics.pages(),
        *configuration.pages(),
        *api.pages(),
        *figures.pages(),
        benchmarks.page(),
        wizards.page(),
        unrevealed.page(),
        never_tried.page(texts),
        symptoms.page(),
        reasons.page(),
    ]
    config.nav = _expanded(config.nav, set(_names(config.nav)))
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add what is not in ``docs/``: made pages, pages of the top level, and every file that a page links to."""
    for page in generated:
        files.append(File.generated(config, page.uri, content=page.text))
    for name in ASSETS:
        files.append(File.generated(config, name, abs_src_path=str(ROOT / "docs" / "site" / name)))
    for name, uri in OUTSIDE.items():
        files.append(File.generated(config, uri, content=(ROOT / name).read_text()))
    written = files.documentation_pages()
    for path in sorted({path for file in written for path in _linked(file.content_string, _origin(file.src_uri))}):
        listing = File.generated(config, f"files/{path}.md", content=_listing(path))
        listing.inclusion = InclusionLevel.NOT_IN_NAV
        files.append(listing)
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Show linked code and figures, and turn links to files of the repository into links of the site."""
    if page.is_homepage:
        page.meta["hide"] = ["navigation"]
    if page.file.src_uri.startswith(UNSEARCHED):
        page.meta["search"] = {"exclude": True}
    return _to_site(figures.shown(source.shown(markdown)), page.file.src_uri)


def _to_site(markdown: str, uri: str) -> str:
    here, folder = _origin(uri), posixpath.dirname(uri)

    def link(found: re.Match[str]) -> str:
        target = _target(found[1], here)
        if target is None:
            return found[0]
        return posixpath.relpath(target, folder or ".") + (found[2] or "")

    return LINK.sub(link, markdown)


def _target(link: str, here: str) -> str | None:
    """Place on the site of a file of the repository; None = there is no such file."""
    path = posixpath.normpath(posixpath.join(posixpath.dirname(here), link))
    if path in OUTSIDE:
        return OUTSIDE[path]
    if path.startswith("docs/figures/"):
        return f"{path.removeprefix('docs/').removesuffix('.json')}.md"
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    return f"files/{path}.md" if (ROOT / path).is_file() else None


def _linked(markdown: str, here: str) -> set[str]:
    targets = {_target(found[1], here) for found in LINK.finditer(markdown)}
    return {t.removeprefix("files/").removesuffix(".md") for t in targets if t is not None and t.startswith("files/")}


def _origin(uri: str) -> str:
    """File of the repository that a page is, seen from the top; made pages count as if they lay in ``docs/``."""
    return {place: name for name, place in OUTSIDE.items()}.get(uri, f"docs/{uri}")


def _listing(path: str) -> str:
    file = ROOT / path
    if file.suffix == ".md":
        return file.read_text()
    language = LANGUAGES.get(file.suffix, "text")
    return join(f"# {path}", f"````{language}\n{file.read_text().rstrip()}\n````")


def _expanded(nav: Any, named: set[str]) -> Any:
    """Navigation with pages in place of ``folder/*``, and all others of the top folder in place of ``*``."""
    if isinstance(nav, dict):
        return {title: _expanded(inner, named) for title, inner in nav.items()}
    if not isinstance(nav, list):
        return nav
    expanded: list[Any] = []
    for item in nav:
        if item == "*":
            expanded += sorted(file.name for file in (ROOT / "docs").glob("*.md") if file.name not in named)
        elif isinstance(item, str) and item.endswith("/*"):
            expanded += _folder(item.removesuffix("*"))
        else:
            expanded.append(_expanded(item, named))
    return expanded


def _names(nav: Any) -> Iterator[str]:
    """Every page that the navigation names."""
    for item in nav.values() if isinstance(nav, dict) else nav:
        if isinstance(item, str):
            yield item
        else:
            yield from _names(item)


def _folder(folder: str) -> list[Any]:
    made = [{page.title: page.uri} for page in generated if page.uri.startswith(folder)]
    return made or sorted((f"{folder}{file.name}" for file in (ROOT / "docs" / folder).glob("*.md")), key=_readme_first)


def _readme_first(uri: str) -> tuple[bool, str]:
    return not uri.endswith("README.md"), uri


def _title(markdown: str) -> str:
    return markdown.partition("# ")[2].partition("\n")[0]
