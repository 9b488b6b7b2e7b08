"""Operator interface of a wizard on a terminal, or answers of a script."""

import asyncio
import os
import sys
import termios
from collections import defaultdict, deque
from collections.abc import Callable
from contextlib import ExitStack
from types import TracebackType
from typing import Self

from monstertruck_runtime.errors import InputError
from monstertruck_runtime.readable import when_readable
from monstertruckd.tools.calibrate.steps import Confirm, Number, Plot
from monstertruckd.tools.cli.output import progress, remark

WORDS = {"y": True, "yes": True, "n": False, "no": False}


class TerminalPanel:
    """Asks on standard error; takes answers first from the command line, then from standard input, line by line.

    Args:
        answers: ``NAME=VALUE`` pairs; repeated names in the order of the questions.
        yes: whether to confirm every requested action.

    Raises:
        InputError: an answer has another format.
    """

    def __init__(self, answers: list[str], *, yes: bool = False) -> None:
        self._given: defaultdict[str, deque[str]] = defaultdict(deque)
        for answer in answers:
            name, equals, value = answer.partition("=")
            if not equals:
                raise InputError(f"--answer {answer}: expected NAME=VALUE")
            self._given[name].append(value)
        self._yes = yes
        self._bars = ExitStack()
        self._bar: tuple[str, Callable[[float], None]] | None = None
        self._rest = b""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close_bar()
        if error is None:
            for name, values in self._given.items():
                for value in values:
                    remark(f"--answer {name}={value}: the wizard did not ask for it")

    def say(self, text: str) -> None:
        """Show a sentence."""
        self._close_bar()
        remark(text)

    def progress(self, name: str, done: float, total: float) -> None:
        """Move the progress bar of this step."""
        if self._bar is None or self._bar[0] != name:
            self._close_bar()
            self._bar = (name, self._bars.enter_context(progress(name, total)))
        self._bar[1](min(done, total))

    def plot(self, plot: Plot) -> None:
        """Show nothing: plots are for the page."""

    async def number(self, step: Number) -> float:
        """Ask until the answer is a number within the bounds; an answer given in advance must be valid."""
        while True:
            text, typed = await self._answer(step.name, step.question)
            try:
                value = float(text.replace(",", "."))
            except ValueError:
                wrong = f"{step.name}: {text!r} is not a number"
            else:
                if step.low <= value <= step.high:
                    return value
                wrong = f"{step.name}: {value:g} is not within {step.low:g} to {step.high:g}"
            if not typed:
                raise InputError(wrong)
            remark(wrong)

    async def confirm(self, step: Confirm) -> bool:
        """Ask for yes or no; Enter means yes for an action."""
        if self._yes and not step.fact:
            return True
        while True:
            text, typed = await self._answer(step.name, f"{step.question} [{'y/n' if step.fact else 'Y/n'}]")
            if (word := WORDS.get(text.lower())) is not None:
                return word
            if not text and not step.fact:
                return True
            wrong = f"{step.name}: {text!r}: expected yes or no"
            if not typed:
                raise InputError(wrong)
            remark(wrong)

    async def _answer(self, name: str, question: str) -> tuple[str, bool]:
        """Return the answer, and whether it was typed."""
        self._close_bar()
        if self._given[name]:
            value = self._given[name].popleft()
            remark(f"{question} {value}")
            return value, False
        self._forget()
        remark(question)
        return await self._line(name), True

    def _forget(self) -> None:
        """Discard input typed before the question, because an extra Enter would let the truck move."""
        if os.isatty(source := sys.stdin.fileno()):
            termios.tcflush(source, termios.TCIFLUSH)
            self._rest = b""

    async def _line(self, name: str) -> str:
        """Read a line of standard input, only when asked: a thread that reads ahead could not be ended by Ctrl-C."""
        loop, source = asyncio.get_running_loop(), sys.stdin.fileno()
        while b"\n" not in self._rest:
            readable = asyncio.Event()
            try:
                when_readable(source, readable.set)
            except PermissionError:  # a file, or /dev/null: always readable
                readable.set()
            try:
                await readable.wait()
            finally:
                loop.remove_reader(source)
            data = os.read(source, 1024)
            if not data:
                raise InputError(f"{name}: no answer on standard input; pass --answer {name}=VALUE")
            self._rest += data
        line, _, self._rest = self._rest.partition(b"\n")
        return line.decode(errors="replace").strip()

    def _close_bar(self) -> None:
        self._bars.close()
        self._bar = None
