"""A second set of operators: other mistakes, found in the syntax tree like those of ``mutants``."""

import ast

from benchmarks.mutation_parts.mutants import SILENT, Finder, Mutant

SECOND = {
    "unassigned": "a name or attribute keeps its value of before, or begins as None",
    "unawaited": "an `await` missing",
    "exchanged": "two neighbouring arguments for each other",
    "shifted": "a limit, a first or a last index a little off",
    "unreturned": "None instead of a result",
    "uncaught": "a handler of exceptions missing",
}
"""What each operator does."""

LIMITS = (ast.Lt, ast.LtE, ast.Gt, ast.GtE)
SHIFT = 1.1
SYMMETRIC = ("min", "max", "zip", "math.hypot", "math.dist", "np.hypot", "np.minimum", "np.maximum")
"""Functions whose arguments may be exchanged, or are in step."""


def second_mutants(file: str, source: bytes) -> list[Mutant]:
    """All mutants of a source by the second set, in the order of their lines."""
    finder = _Second(file, source)
    finder.visit(ast.parse(source))
    found = [mutant for mutant in finder.found if mutant.operator in SECOND]  # the visitors of the first set add theirs
    return sorted(found, key=lambda mutant: (mutant.line, mutant.span, mutant.after))


class _Second(Finder):
    """Finds mutants of the second set."""

    def __init__(self, file: str, source: bytes) -> None:
        super().__init__(file, source)
        self._bound: list[set[str]] = []
        """Names that the functions around have bound so far."""

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        self._function(node)

    def visit_AsyncFunctionDef(self, node: ast.AsyncFunctionDef) -> None:
        self._function(node)

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        self.named(node)

    def _function(self, node: ast.FunctionDef | ast.AsyncFunctionDef) -> None:
        arguments = node.args
        self._bound.append({each.arg for each in (*arguments.args, *arguments.kwonlyargs, *arguments.posonlyargs)})
        self.named(node)
        self._bound.pop()

    # Statements

    def visit_Assign(self, node: ast.Assign) -> None:
        if isinstance(node.value, ast.Subscript) and self.text(node.value).startswith("Annotated"):
            return
        for target in node.targets:
            self._unassign(node, target, node.value)
        self.visit(node.value)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self._unassign(node, node.target, node.value)
            self.visit(node.value)

    def _unassign(self, node: ast.Assign | ast.AnnAssign, target: ast.expr, value: ast.expr) -> None:
        if isinstance(target, ast.Name) and self._bound:
            if target.id in self._bound[-1]:
                self.add("unassigned", node, "pass")
            self._bound[-1].add(target.id)
        elif isinstance(target, ast.Attribute) and self.path[-1:] == ["__init__"] and self.text(value) != "None":
            self.add("unassigned", node, f"{self.text(target)} = None")

    def visit_Return(self, node: ast.Return) -> None:
        if node.value is not None:
            if self.text(node.value) != "None":
                self.add("unreturned", node, "return None")
            self.visit(node.value)

    def visit_ExceptHandler(self, node: ast.ExceptHandler) -> None:
        if node.type is not None:
            self.add("uncaught", node.type, "()")
        self.generic_visit(node)

    def visit_Assert(self, node: ast.Assert) -> None:
        """Skip: an assert states an invariant."""

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        """Skip text for people."""

    # Expressions

    def visit_Await(self, node: ast.Await) -> None:
        self.add("unawaited", node, self.text(node.value))
        self.visit(node.value)

    def visit_Call(self, node: ast.Call) -> None:
        function = self.text(node.func)
        if function.startswith(SILENT) or function == "Field":
            return
        if function in SYMMETRIC:
            self.generic_visit(node)
            return
        texts = [self.text(argument) for argument in node.args]
        keys = [f"{each.arg}=" if each.arg else "**" for each in node.keywords]
        values = [self.text(each.value) for each in node.keywords]
        for texts_of, other in ((texts, False), (values, True)):
            for at in range(len(texts_of) - 1):
                one, two = texts_of[at : at + 2]
                if one == two or one.startswith("*") or two.startswith("*"):
                    continue
                swapped = [*texts_of[:at], two, one, *texts_of[at + 2 :]]
                given = texts if other else swapped
                named = [key + value for key, value in zip(keys, swapped if other else values, strict=True)]
                self.add("exchanged", node, f"{self.text(node.func)}({', '.join((*given, *named))})")
        self.generic_visit(node)

    def visit_Compare(self, node: ast.Compare) -> None:
        limit = node.comparators[-1]
        zero = isinstance(limit, ast.Constant) and not limit.value
        if len(node.ops) == 1 and isinstance(node.ops[0], LIMITS) and not zero:
            left, sign = self.text(node.left), self.text(node)[len(self.text(node.left)) :].split()[0]
            counts = left.startswith("len(")
            for change in ("+ 1", "- 1") if counts else (f"* {SHIFT}", f"/ {SHIFT}"):
                self.add("shifted", node, f"({left}) {sign} ({self.text(limit)}) {change}")
        self.generic_visit(node)

    def visit_Subscript(self, node: ast.Subscript) -> None:
        place = node.slice
        if isinstance(place, ast.Constant) and isinstance(place.value, int):
            self.add("shifted", place, "-1" if place.value == 0 else "0")
        elif isinstance(place, ast.Slice) and place.step is None:
            lower, upper = (None if each is None else self.text(each) for each in (place.lower, place.upper))
            self.add("shifted", node, f"{self.text(node.value)}[({lower or 0}) + 1:{upper or ''}]")
        self.visit(node.value)

    def visit_keyword(self, node: ast.keyword) -> None:
        """Skip ``strict=True`` of ``zip``, which states an invariant."""
        if node.arg != "strict":
            self.visit(node.value)
