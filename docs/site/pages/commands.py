"""One page for each command, made from the command line itself."""

import inspect
import re
from collections.abc import Iterator, Mapping
from enum import Enum
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import typer

from monstertruckd.tools.cli.main import app
from pages.markdown import Page, join, table

ROOT = Path(__file__).resolve().parents[3]
EXIT_CODES = """\
0 when it did what was asked, 2 for a wrong option or a refused configuration, 6 when Ctrl-C or SIGTERM cut it short;
every other failure has its own code: [reasons](../reasons.md)."""


def pages(texts: Mapping[str, tuple[str, str]]) -> list[Page]:
    """Overview, then a page for each command.

    Args:
        texts: title and Markdown of the pages written by hand, by place: they are searched for each command.
    """
    commands = list(walk(typer.main.get_command(app), ()))
    rows = [(f"[`{' '.join(name)}`]({_file(name)})", _summary(command)) for name, command in commands]
    overview = join(
        "# Commands",
        "What all of them share, driving by keyboard and the exit codes: [the command line](../command-line.md).",
        table(("command", "what it does"), rows),
        "`monstertruckd --version` prints the version, `monstertruckd --install-completion` teaches your shell.",
    )
    return [Page("commands/index.md", "All commands", overview), *(_page(name, c, texts) for name, c in commands)]


def walk(command: Any, name: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """All commands that do something and are not hidden, by name."""
    inner = getattr(command, "commands", None)
    if inner is None:
        if not command.hidden:
            yield name, command
        return
    for word, deeper in inner.items():
        yield from walk(deeper, (*name, word))


def _page(name: tuple[str, ...], command: Any, texts: Mapping[str, tuple[str, str]]) -> Page:
    arguments = [p for p in command.params if p.param_type_name == "argument"]
    options = [p for p in command.params if p.param_type_name == "option" and p.name != "help" and not p.hidden]
    usage = " ".join(["monstertruckd", *name, *map(_argument, arguments), *(["[OPTIONS]"] if options else [])])
    mentioned = [f"[{title}](../{uri})" for uri, (title, text) in texts.items() if _mentions(text, name)]
    text = join(
        f"# monstertruckd {' '.join(name)}",
        f"```text\n{usage}\n```",
        inspect.cleandoc(command.help),
        table(("argument", "default", "what"), [(f"`{_name(p)}`", _default(p), _help(p)) for p in arguments]),
        table(("option", "default", "what"), [(_flags(p), _default(p), _help(p)) for p in options]),
        "## Exit code",
        EXIT_CODES,
        f"Read on: {', '.join(mentioned)}." if mentioned else "",
    )
    return Page(f"commands/{_file(name)}", " ".join(name), text)


def _file(name: tuple[str, ...]) -> str:
    return f"{'-'.join(name)}.md"


def _summary(command: Any) -> str:
    return inspect.cleandoc(command.help).partition("\n\n")[0]


def _name(parameter: Any) -> str:
    return str(parameter.metavar or parameter.name.upper().rstrip("_"))


def _argument(parameter: Any) -> str:
    name = _name(parameter) + ("..." if parameter.nargs == -1 else "")
    return name if parameter.required else f"[{name}]"


def _flags(parameter: Any) -> str:
    value = "" if parameter.is_flag else f" {parameter.metavar or _type(parameter)}"
    flags = ", ".join(f"`{flag}`" for flag in sorted(parameter.opts, key=len, reverse=True))
    off = "".join(f", `{flag}`" for flag in parameter.secondary_opts)
    return f"{flags}{off}{f' `{value.strip()}`' if value else ''}{', repeatable' if parameter.multiple else ''}"


def _type(parameter: Any) -> str:
    kind = parameter.type_descriptor.annotation
    if get_origin(kind) is Literal:
        return "|".join(map(str, get_args(kind)))
    (kind,) = get_args(kind)[:1] or (kind,)
    if issubclass(kind, Enum):
        return "|".join(str(member.value) for member in kind)
    return {Path: "PATH", str: "TEXT", int: "N", float: "X"}.get(kind, kind.__name__.upper())


def _help(parameter: Any) -> str:
    limits = [f"{w} {n:g}" for w, n in (("at least", parameter.min), ("at most", parameter.max)) if n is not None]
    return " ".join([parameter.help or "", f"({', '.join(limits)})" if limits else ""]).strip()


def _default(parameter: Any) -> str:
    if parameter.required:
        return "required"
    value = parameter.default
    if value is None or value is False:
        return ""
    if isinstance(value, Path) and value.is_relative_to(ROOT):
        value = value.relative_to(ROOT)
    return f"`{getattr(value, 'value', value)}`"


def _mentions(text: str, name: tuple[str, ...]) -> bool:
    words = re.escape(" ".join(name))
    return re.search(rf"(monstertruckd {words}|`{words})(?![\w-])", text) is not None
