"""Single-point faults in a Python source: plausible mistakes, found in its syntax tree."""

import ast
from collections.abc import Iterator
from dataclasses import dataclass

OPERATORS = {
    "boundary": "a comparison takes its limit in, or leaves it out",
    "negated": "a comparison the other way round",
    "connective": "`and` for `or`, or the other way round",
    "dropped": "one operand of `and` or `or`, argument of `min` or `max`, element of a collection or filter missing",
    "sign": "a minus, or a `not`, missing",
    "arithmetic": "plus for minus, times for divided, union for intersection, and the other way round",
    "condition": "a condition that always, or never, holds",
    "number": "another number: one more, or twice as much",
    "flag": "True for False, or the other way round",
    "swapped": "`min` for `max`, `any` for `all`, and the other way round",
    "left out": "a call, an assignment, a raise, a break or a continue missing",
}
"""What each operator does."""

COMPARISONS: dict[type[ast.cmpop], tuple[tuple[str, str], ...]] = {
    ast.Lt: (("boundary", "<="), ("negated", ">=")),
    ast.LtE: (("boundary", "<"), ("negated", ">")),
    ast.Gt: (("boundary", ">="), ("negated", "<=")),
    ast.GtE: (("boundary", ">"), ("negated", "<")),
    ast.Eq: (("negated", "!="),),
    ast.NotEq: (("negated", "=="),),
    ast.Is: (("negated", "is not"),),
    ast.IsNot: (("negated", "is"),),
    ast.In: (("negated", "not in"),),
    ast.NotIn: (("negated", "in"),),
}
SYMBOLS: dict[type[ast.AST], str] = {
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=",
    ast.Is: "is", ast.IsNot: "is not", ast.In: "in", ast.NotIn: "not in",
    ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.FloorDiv: "//", ast.Mod: "%",
    ast.BitOr: "|", ast.BitAnd: "&",
}  # fmt: skip
ARITHMETIC: dict[type[ast.operator], str] = {
    ast.Add: "-",
    ast.Sub: "+",
    ast.Mult: "/",
    ast.Div: "*",
    ast.FloorDiv: "*",
    ast.Mod: "*",
    ast.BitOr: "&",
    ast.BitAnd: "|",
}
SWAPPED = {"min": "max", "max": "min", "any": "all", "all": "any"}
ATOMS = (ast.Name, ast.Attribute, ast.Constant, ast.Call, ast.Subscript)
"""Operands that need no parentheses."""
SILENT = ("log.", "_log.")
"""Calls whose loss nobody can see."""


@dataclass(frozen=True)
class Mutant:
    """A source with one fault."""

    file: str
    """Relative to the project."""
    line: int
    statement: int
    """First line of the statement it is in."""
    operator: str
    where: str
    """Qualified name of the function or class it is in."""
    before: str
    after: str
    span: tuple[int, int]
    """Bytes of the source that ``after`` replaces."""
    scope: range
    """Lines of ``where``."""

    @property
    def key(self) -> str:
        """Identifier independent of the line number."""
        return f"{self.file}::{self.where}: {self.before} -> {self.after}"

    def applied(self, source: bytes) -> bytes:
        """The faulty source."""
        begin, end = self.span
        return source[:begin] + self.after.encode() + source[end:]


def mutants(file: str, source: bytes) -> list[Mutant]:
    """All mutants of a source, in the order of their lines."""
    finder = Finder(file, source)
    finder.visit(ast.parse(source))
    return sorted(finder.found, key=lambda mutant: (mutant.line, mutant.span, mutant.after))


class Finder(ast.NodeVisitor):
    def __init__(self, file: str, source: bytes) -> None:
        self.found: list[Mutant] = []
        self._file = file
        self._source = source
        lines = source.splitlines(keepends=True)
        self._starts = [sum(map(len, lines[:i])) for i in range(len(lines) + 1)]
        self.path: list[str] = []
        self._scope = range(1, len(lines) + 1)
        self._statement = 0

    def visit(self, node: ast.AST) -> None:
        """Find the mutants of a node."""
        outer = self._statement
        if isinstance(node, ast.stmt):
            self._statement = node.lineno
        super().visit(node)
        self._statement = outer

    def _span(self, node: ast.expr | ast.stmt) -> tuple[int, int]:
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        begin = self._starts[node.lineno - 1] + node.col_offset
        return begin, self._starts[node.end_lineno - 1] + node.end_col_offset

    def text(self, node: ast.expr | ast.stmt) -> str:
        begin, end = self._span(node)
        return self._source[begin:end].decode()

    def add(self, operator: str, node: ast.expr | ast.stmt, after: str) -> None:
        before = self.text(node)
        if after == before:
            return
        after = after if isinstance(node, ast.stmt) or after.isidentifier() else f"({after})"
        where = ".".join(self.path) or "module"
        place = self._file, node.lineno, self._statement
        self.found.append(Mutant(*place, operator, where, before, after, self._span(node), self._scope))

    # Statements

    def named(self, node: ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) -> None:
        assert node.end_lineno is not None
        outer, self._scope = self._scope, range(node.lineno, node.end_lineno + 1)
        self.path.append(node.name)
        for statement in node.body:
            self.visit(statement)
        if not isinstance(node, ast.ClassDef):
            for default in (*node.args.defaults, *(d for d in node.args.kw_defaults if d is not None)):
                self.visit(default)
        self.path.pop()
        self._scope = outer

    visit_FunctionDef = visit_AsyncFunctionDef = visit_ClassDef = named  # noqa: N815

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self._assigned(node, node.target)
            self.visit(node.value)

    def visit_Assign(self, node: ast.Assign) -> None:
        if isinstance(node.value, ast.Subscript) and self.text(node.value).startswith("Annotated"):
            return
        self._assigned(node, node.targets[0])
        self.visit(node.value)

    def _assigned(self, node: ast.Assign | ast.AnnAssign, target: ast.expr) -> None:
        if self.path[-1:] != ["__init__"] and isinstance(target, (ast.Attribute, ast.Subscript)):
            self.add("left out", node, "pass")

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        self.add("left out", node, "pass")
        if (other := ARITHMETIC.get(type(node.op))) is not None:
            self.add("arithmetic", node, f"{self.text(node.target)} {other}= {self.text(node.value)}")
        self.visit(node.value)

    def visit_Expr(self, node: ast.Expr) -> None:
        value = node.value
        if isinstance(value, ast.Constant) or self.text(node).startswith(SILENT):
            return
        if isinstance(value, (ast.Call, ast.Await)):
            self.add("left out", node, "pass")
        self.visit(value)

    def visit_Raise(self, node: ast.Raise) -> None:
        self.add("left out", node, "pass")

    def visit_Break(self, node: ast.Break) -> None:
        self.add("left out", node, "pass")

    def visit_Continue(self, node: ast.Continue) -> None:
        self.add("left out", node, "pass")

    def visit_Assert(self, node: ast.Assert) -> None:
        """Skip: an assert states an invariant."""

    def visit_keyword(self, node: ast.keyword) -> None:
        """Skip ``strict=True`` of ``zip``, which states an invariant."""
        if node.arg != "strict":
            self.visit(node.value)

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        """Skip text for people."""

    def _conditional(self, node: ast.If | ast.While | ast.IfExp) -> None:
        if "TYPE_CHECKING" not in self.text(node.test) and not isinstance(node.test, ast.Constant):
            always = () if isinstance(node, ast.While) else ("True",)
            for value in (*always, "False"):
                self.add("condition", node.test, value)
        self.generic_visit(node)

    visit_If = visit_While = visit_IfExp = _conditional  # noqa: N815

    # Expressions

    def visit_Compare(self, node: ast.Compare) -> None:
        parts = [node.left, *node.comparators]
        for index, op in enumerate(node.ops):
            for operator, other in COMPARISONS[type(op)]:
                signs = [SYMBOLS[type(each)] for each in node.ops]
                signs[index] = other
                texts = [self.text(part) if isinstance(part, ATOMS) else f"({self.text(part)})" for part in parts]
                rest = "".join(f" {sign} {text}" for sign, text in zip(signs, texts[1:], strict=True))
                self.add(operator, node, texts[0] + rest)
        for part in node.comparators:
            if isinstance(part, ast.Tuple):
                self._drop(part)
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        here, other = ("and", "or") if isinstance(node.op, ast.And) else ("or", "and")
        texts = [f"({self.text(value)})" for value in node.values]
        self.add("connective", node, f" {other} ".join(texts))
        for index in range(len(texts)):
            self.add("dropped", node, f" {here} ".join(texts[:index] + texts[index + 1 :]))
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        if isinstance(node.op, (ast.Not, ast.USub)):
            self.add("sign", node, self.text(node.operand))
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        if (other := ARITHMETIC.get(type(node.op))) is not None and not isinstance(node.left, ast.JoinedStr):
            self.add("arithmetic", node, f"({self.text(node.left)}) {other} ({self.text(node.right)})")
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        value = node.value
        if isinstance(value, bool):
            self.add("flag", node, str(not value))
        elif isinstance(value, int):
            self.add("number", node, str(value + 1))
        elif isinstance(value, float):
            self.add("number", node, repr(value * 2 or 1.0))

    def visit_Call(self, node: ast.Call) -> None:
        name = node.func.id if isinstance(node.func, ast.Name) else ""
        if name == "Field" or self.text(node.func).startswith(SILENT):
            return
        if name in SWAPPED:
            self.add("swapped", node, SWAPPED[name] + self.text(node)[len(name) :])
        if name in ("min", "max") and len(node.args) > 1:
            texts = [self.text(argument) for argument in node.args]
            rest = [self.text(keyword.value) for keyword in node.keywords]
            named = [f"{k.arg}={text}" for k, text in zip(node.keywords, rest, strict=True)]
            for index in range(len(texts)):
                kept = texts[:index] + texts[index + 1 :]
                alone = len(kept) == 1 and not kept[0].startswith("*") and not named
                self.add("dropped", node, kept[0] if alone else f"{name}({', '.join(kept + named)})")
        self.generic_visit(node)

    def _drop(self, node: ast.Set | ast.Tuple) -> None:
        texts = [self.text(element) for element in node.elts]
        if len(texts) < 2:
            return
        for index in range(len(texts)):
            inner = ", ".join(texts[:index] + texts[index + 1 :])
            self.add("dropped", node, f"{{{inner}}}" if isinstance(node, ast.Set) else f"{inner},")

    def visit_Set(self, node: ast.Set) -> None:
        self._drop(node)
        self.generic_visit(node)

    def visit_Dict(self, node: ast.Dict) -> None:
        keys = [f"{self.text(key)}: " if key is not None else "**" for key in node.keys]
        texts = [key + self.text(value) for key, value in zip(keys, node.values, strict=True)]
        if len(texts) > 1:
            for index in range(len(texts)):
                self.add("dropped", node, "{" + ", ".join(texts[:index] + texts[index + 1 :]) + "}")
        self.generic_visit(node)

    def visit_comprehension(self, node: ast.comprehension) -> None:
        for test in node.ifs:
            self.add("dropped", test, "True")
        self.generic_visit(node)


def all_mutants(files: dict[str, bytes]) -> Iterator[Mutant]:
    """Return the mutants of all files, by their names relative to the project."""
    for file, source in files.items():
        yield from mutants(file, source)
