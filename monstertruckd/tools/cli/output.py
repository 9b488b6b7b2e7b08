"""Features common to all commands: ``--json``, plain text in pipes, progress bars, exit codes by reason.

Results are written to standard output, everything else (remarks, progress, errors) to standard error. Errors are raised
as ``TruckError``; ``CommandGroup`` prints them as one sentence and exits with the exit code of their reason. Ctrl-C and
SIGTERM are equivalent: commands that run until stopped exit with 0 (``until_stopped``), all others give up with
``CANCELLED``.
"""

import json
import math
import os
import re
import shutil
import signal
import sys
import textwrap
from collections.abc import Callable, Coroutine, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, Final, Protocol, TextIO, cast

import typer
from typer.core import TyperCommand, TyperGroup

from monstertruck_runtime.errors import RequestRefusedError, TruckError, disk_reason, first_of
from monstertruck_schemas.reasons import Reason

if TYPE_CHECKING:
    from rich.console import Console
    from typer._click import Context
    from typer.core import TyperOption
    from typer.models import CommandFunctionType

    from monstertruck_runtime.clock import WallClock

PIPE_WIDTH: Final = 200
"""Width of text that is not written to a terminal: wide enough to avoid truncation."""

WIDE_CELL: Final = 48
"""Longer cells fold on a terminal; in a pipe they exceed their column instead of widening it."""


def on_terminal(stream: TextIO | None) -> bool:
    """Return whether a standard stream is a terminal; the stream is None if it was closed before the start."""
    return stream is not None and stream.isatty()


HELP_STYLE: Final = "markdown" if on_terminal(sys.stdout) and on_terminal(sys.stderr) else None
"""Style of help and usage errors: framed on terminals, plain text (None) if either stream is a pipe."""

HELP_SETTINGS: Final[dict[str, Any]] = {
    "max_content_width" if on_terminal(sys.stdout) else "terminal_width": PIPE_WIDTH,
    "help_option_names": ["-h", "--help"],
}
"""Settings of the command line: the terminal's width, or unfolded lines; ``-h`` is ``--help`` everywhere."""

JsonOption = Annotated[bool, typer.Option("--json", help="Machine-readable output.")]


def print_json(value: Any, *, indent: int | None = 2) -> None:
    """Print one JSON value; models and enums become plain values, non-finite numbers null.

    Args:
        value: value of mappings, sequences, models and scalars.
        indent: indentation; None: one line, for streams of values.
    """
    from monstertruck_runtime.plain import plain

    print(json.dumps(plain(value), indent=indent, allow_nan=False), flush=indent is None)


def console(*, error: bool = False) -> "Console":
    """Console for styled text: plain and untruncated unless it is a terminal."""
    from rich.console import Console

    class PipedConsole(Console):
        def on_broken_pipe(self) -> None:
            raise BrokenPipeError

    terminal = on_terminal(sys.stderr if error else sys.stdout)
    width = None if terminal else PIPE_WIDTH
    return PipedConsole(stderr=error, width=width, highlight=False, soft_wrap=not terminal)


def print_table(
    headings: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    right: Sequence[str] = (),
    title: str | None = None,
) -> None:
    """Print rows below headings: on a terminal as a folding table, in a pipe one unfolded line per row.

    If a terminal has no room for the last column, its cells are printed on separate lines, broken between words: a path
    is whole.

    Args:
        headings: one per column.
        rows: cells.
        right: headings of the right-aligned columns (numbers).
        title: title line, on terminals only.
    """
    if not on_terminal(sys.stdout):
        print("\n".join(_aligned(headings, rows, right)))
        return
    if headings[-1] not in right and not _has_room([headings, *rows]):
        print("\n".join(_with_last_below(headings, rows, right, title)))
        return
    from rich.table import Table

    table = Table(box=None, header_style="bold", pad_edge=False, title=title, title_justify="left")
    for heading, cells in zip(headings, zip(headings, *rows, strict=True), strict=True):
        whole = max(map(len, cells)) <= WIDE_CELL
        table.add_column(heading, justify="right" if heading in right else "left", no_wrap=whole, overflow="fold")
    for row in rows:
        table.add_row(*row)
    console().print(table)


def _has_room(lines: Sequence[Sequence[str]]) -> bool:
    """Return whether the last column of a table fits into a terminal, or folds into readable lines."""
    *others, last = zip(*lines, strict=True)
    room = shutil.get_terminal_size().columns - sum(max(map(len, column)) + 2 for column in others)
    longest_word = max((len(word) for cell in last for word in cell.split()), default=0)
    # 24: minimum width of a column of words on a terminal; narrower columns are printed below their row
    return max(map(len, last)) <= room or (room >= 24 and longest_word <= room)


def _with_last_below(
    headings: Sequence[str], rows: Sequence[Sequence[str]], right: Sequence[str], title: str | None
) -> Iterator[str]:
    if title is not None:
        yield title
    others = _aligned(headings[:-1], [row[:-1] for row in rows], right)
    for line, last in zip(others, [headings[-1], *(row[-1] for row in rows)], strict=True):
        yield line
        yield wrapped(last, indent="  ")


def _aligned(headings: Sequence[str], rows: Sequence[Sequence[str]], right: Sequence[str]) -> list[str]:
    lines = [[heading.replace("\n", " ") for heading in headings], *map(list, rows)]
    widths = [max(len(cell) for cell in column if len(cell) <= WIDE_CELL) for column in zip(*lines, strict=True)]
    to_the_right = [heading in right for heading in headings]
    return [
        "  ".join(
            cell.rjust(width) if on_right else cell.ljust(width)
            for cell, width, on_right in zip(line, widths, to_the_right, strict=True)
        ).rstrip()
        for line in lines
    ]


def remark(text: str) -> None:
    """Print a remark on standard error, so that standard output contains only the result.

    On a terminal words are not broken.
    """
    if sys.stderr is not None:  # print() would write to standard output
        if on_terminal(sys.stderr):
            text = wrapped(text)
        print(text, file=sys.stderr, flush=True)


def print_words(text: str) -> None:
    """Print words on standard output immediately; on a terminal words are not broken."""
    print(wrapped(text) if on_terminal(sys.stdout) else text, flush=True)


def wrapped(text: str, indent: str = "") -> str:
    """Break text between words at the width of the terminal; words without blanks, such as paths, are kept."""
    wrapper = textwrap.TextWrapper(
        shutil.get_terminal_size().columns,
        initial_indent=indent,
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return "\n".join("\n".join(wrapper.wrap(line)) for line in text.split("\n"))


class Bar(Protocol):
    """Progress display."""

    def __call__(self, done: float, what: str | None = None, /) -> None:
        """Set the amount done, and ``what`` if the activity has changed."""
        ...


@contextmanager
def progress(what: str, total: float | None = None) -> Iterator[Bar]:
    """Show a bar on standard error if it is a terminal; yield a function that sets how much of ``total`` is done.

    Args:
        what: activity, in a few words.
        total: total amount; None: unknown.
    """
    if not on_terminal(sys.stderr):
        yield lambda _done, _what=None: None
        return
    from rich.progress import Progress

    with Progress(console=console(error=True), transient=True) as bar:
        task = bar.add_task(what, total=total)
        yield lambda done, now=None: bar.update(task, completed=done, description=now)


REMEDIES: Final = {
    Reason.DISARMED: ("monstertruckd arm", "lets it drive"),
    Reason.ESTOPPED: ("monstertruckd reset", "clears the emergency stop"),
}
"""Command that removes the cause of a refusal, and its effect."""

WHICH_ROBOT: Final = "monstertruckd.which_robot"
"""Key of a command's context: its options ``--robot`` and ``--endpoint`` as given."""


def finish(reason: Reason, text: str = "") -> None:
    """Exit with the exit code of ``reason``, after a sentence if it is not zero.

    Raises:
        Exit: the reason is not a success.
    """
    if reason.exit_code:
        remark(with_remedy(reason, text or reason.text))
        raise typer.Exit(reason.exit_code)


def with_remedy(reason: Reason, text: str) -> str:
    """Describe a refusal and the command that removes its cause, if any, for the same robot."""
    from typer._click.globals import get_current_context

    if reason not in REMEDIES:
        return text
    command, effect = REMEDIES[reason]
    context = get_current_context(silent=True)
    which: dict[str, str] = {} if context is None else context.meta.get(WHICH_ROBOT, {})
    remedy = f"`{' '.join((command, *which.values()))}` {effect}"
    return text if remedy in text else f"{text}; {remedy}"


def print_end(reason: Reason, text: str, values: Mapping[str, Any], *, json_output: bool) -> None:
    """Print how a drive or another run ended, and exit with its reason.

    Angles are also shown in degrees. The robot's text keeps rad, because recorded runs are compared word by word.

    Args:
        reason: reason of the end.
        text: description of the end.
        values: data of the JSON output.
        json_output: whether to print JSON.

    Raises:
        Exit: the reason is not a success.
    """
    if json_output:
        print_json(values)
    shown = re.sub(r"([-+]?\d+\.\d+) rad\b(?!/)", lambda rad: f"{rad[0]} ({math.degrees(float(rad[1])):.1f}°)", text)
    whole = shown if reason.text in shown else f"{reason.text}: {shown}"
    if not json_output and not reason.exit_code:
        print_words(whole)
    finish(reason, whole)


def until_stopped(main: "Callable[[WallClock], Coroutine[Any, Any, None]]") -> None:
    """Run ``main(clock)`` until it returns, or until Ctrl-C or SIGTERM, which are normal ends."""
    from monstertruck_runtime.clock import run_wall

    with suppress(KeyboardInterrupt):
        run_wall(main)


class NumberCommand(TyperCommand):
    """Command that refuses nan, which passes every comparison with a bound."""

    def make_context(self, *arguments: Any, **settings: Any) -> "Context":
        """Parse its options."""
        context = super().make_context(*arguments, **settings)
        for parameter in self.params:
            value = context.params.get(parameter.name or "")
            numbers = value if isinstance(value, list | tuple) else [value]
            if any(isinstance(number, float) and math.isnan(number) for number in numbers):
                raise typer.BadParameter("expected a number, not nan", context, cast("TyperOption", parameter))
        return context


class Commands(typer.Typer):
    """Group of ``NumberCommand``."""

    def command(
        self, name: str | None = None, **settings: Any
    ) -> "Callable[[CommandFunctionType], CommandFunctionType]":
        """Add a command."""
        return super().command(name, **{"cls": NumberCommand, **settings})


def command_group(text: str) -> typer.Typer:
    """Create an empty group of commands with the description ``text``."""
    return Commands(help=text, no_args_is_help=True, rich_markup_mode=HELP_STYLE)


class CommandGroup(TyperGroup):
    """Root of the command line: converts expected errors, unusable files, interrupts and closed pipes to exit codes."""

    def make_context(self, *arguments: Any, **settings: Any) -> "Context":
        """Parse the options of the program itself."""
        with _usage_in_one_line():
            return super().make_context(*arguments, **settings)

    def invoke(self, ctx: "Context") -> Any:
        """Run the chosen command."""
        before = signal.getsignal(signal.SIGTERM)
        if before is signal.SIG_DFL:  # `run` handles them itself
            signal.signal(signal.SIGTERM, _interrupt)
        try:
            return self._invoke_and_flush(ctx)
        except TruckError as error:
            reason = error.refusal if isinstance(error, RequestRefusedError) else error.reason
            remark(with_remedy(reason, str(error) or reason.text))
            raise typer.Exit(reason.exit_code) from None
        except ModuleNotFoundError as error:
            if error.name is None or error.name.startswith("monstertruck"):
                raise
            remark(
                f"{error.name} is not installed: install the extra that contains it (monstertruckd doctor "
                "prints the command)"
            )
            raise typer.Exit(Reason.NOT_INSTALLED.exit_code) from None
        except KeyboardInterrupt:
            remark(Reason.CANCELLED.text)
            raise typer.Exit(Reason.CANCELLED.exit_code) from None
        except BrokenPipeError:  # for example `monstertruckd echo | head`: the reader needs no more
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit from None
        except OSError as error:
            full = disk_reason(error) is Reason.DISK_FULL
            if full and error.filename is None:  # probably standard output, which must not be used again
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            if not full and error.filename is None:
                raise
            where = "" if error.filename is None else f"{os.fsdecode(error.filename)}: "
            remark(f"{where}{error.strerror}")
            raise typer.Exit((Reason.DISK_FULL if full else Reason.BAD_INPUT).exit_code) from None
        finally:
            signal.signal(signal.SIGTERM, before)

    def _invoke_and_flush(self, ctx: "Context") -> Any:
        try:
            with _usage_in_one_line():
                return super().invoke(ctx)
        except BaseExceptionGroup as group:
            raise first_of(group, TruckError) or group from None
        finally:
            if sys.stdout is not None:
                sys.stdout.flush()


@contextmanager
def _usage_in_one_line() -> Iterator[None]:
    """Print a usage error in one line, with the command for help."""
    from typer._click.exceptions import MissingParameter, NoArgsIsHelpError, UsageError

    try:
        yield
    except NoArgsIsHelpError:  # a group without a command: print its help
        raise
    except UsageError as error:
        complaint = in_own_words(" ".join(error.format_message().split()).removesuffix("."))
        if isinstance(error, MissingParameter) and (wanted := getattr(error.param, "help", None)):
            complaint += f". {wanted.removesuffix('.')}"
        command = "monstertruckd" if error.ctx is None else error.ctx.command_path
        remark(f"Error: {complaint}{'' if complaint.endswith('?') else '.'} Try '{command} -h'.")
        raise typer.Exit(error.exit_code) from None


def in_own_words(complaint: str) -> str:
    """Without the phrases of the library that reads values."""
    text = complaint.replace(": Value error, ", ": ").replace(": Input should be ", ": expected ")
    text = text.replace(": expected a valid integer", ": expected a whole number")
    return text.replace(": expected a valid ", ": expected a ").partition(", unable to parse string")[0]


def _interrupt(_: int, frame: FrameType | None) -> None:
    """Make SIGTERM equivalent to Ctrl-C, even if a shell made a background job ignore it.

    A second signal, such as timeout(1) sends to the whole group, does not disturb the shutdown.
    """
    signal.signal(signal.SIGTERM, lambda *_: None)
    handler = signal.getsignal(signal.SIGINT)
    if callable(handler):
        handler(signal.SIGINT, frame)
    else:
        raise KeyboardInterrupt
