"""The single changes that ``tools.mutate`` makes: operators, constants, conditions and arguments left out.

What crashes at once, or changes nothing but looks, is left out by rule: annotations, decorators, messages, conditions
of refusals, texts, fields of classes.
"""

from __future__ import annotations

import ast
import random
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

SWAPS: dict[type[ast.AST], tuple[str, str]] = {
    ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*"), ast.FloorDiv: ("//", "/"),
    ast.Mod: ("%", "//"), ast.Pow: ("**", "*"), ast.BitAnd: ("&", "|"), ast.BitOr: ("|", "&"),
    ast.LShift: ("<<", ">>"), ast.RShift: (">>", "<<"), ast.Lt: ("<", "<="), ast.LtE: ("<=", "<"), ast.Gt: (">", ">="),
    ast.GtE: (">=", ">"), ast.Eq: ("==", "!="), ast.NotEq: ("!=", "=="), ast.Is: ("is", "is not"),
    ast.IsNot: ("is not", "is"), ast.In: ("in", "not in"), ast.NotIn: ("not in", "in"), ast.And: ("and", "or"),
    ast.Or: ("or", "and"),
}  # fmt: skip
#: Arguments of which another value, or none, is looks, the same, or an error at once.
EQUAL = {
    "frozen", "slots", "strict", "encoding", "exist_ok", "parents", "prefix", "suffix", "description", "stacklevel",
    "help", "metavar", "daemon", "name", "copy", "order", "eq", "kw_only", "default_factory", "dtype", "indent",
}  # fmt: skip
#: Names of values that are joined to paths by "/".
PATHS = re.compile(r"(path|folder|root|directory|out|home|dir|parent|cwd)\b|Path\(")
#: Calls that only say something.
TOLD = re.compile(r"(warn|print|log|add_argument|TypeVar)$")


@dataclass(frozen=True)
class Change:
    """One change: ``before`` is the text from byte ``start`` to ``end`` of a file, ``after`` takes its place."""

    path: str
    line: int
    start: int
    end: int
    before: str
    after: str

    def apply(self, data: bytes) -> bytes:
        """Return the file with the change."""
        return data[: self.start] + self.after.encode() + data[self.end :]


class _Finder:
    """Walks a file and collects its changes."""

    def __init__(self, path: str, data: bytes) -> None:
        self.path, self.data = path, data
        self.starts = [0]
        for line in data.splitlines(keepends=True):
            self.starts.append(self.starts[-1] + len(line))
        self.found: list[Change] = []

    def span(self, node: ast.expr | ast.keyword) -> tuple[int, int]:
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        return self.starts[node.lineno - 1] + node.col_offset, self.starts[node.end_lineno - 1] + node.end_col_offset

    def add(self, start: int, end: int, after: str) -> None:
        """Note a change."""
        line = self.data.count(b"\n", 0, start) + 1
        self.found.append(
            Change(path=self.path, line=line, start=start, end=end, before=self.data[start:end].decode(), after=after)
        )

    def operator(self, operator: ast.AST, left: ast.expr, right: ast.expr) -> None:
        """Swap what stands between two operands."""
        start, end = self.span(left)[1], self.span(right)[0]
        old, new = SWAPS.get(type(operator), ("", ""))
        between = self.data[start:end].decode()
        text = ast.unparse(left) + " " + ast.unparse(right)
        joined = (old == "/" and PATHS.search(text)) or (old == "+" and isinstance(left, ast.List | ast.Tuple))
        texts = (old in ("+", "%", "/", "*") and re.search(r"[\"']", text)) or (old == "|" and "None" in text)
        if not old or joined or texts:
            return
        at = between.find(old)
        self.add(start + at, start + at + len(old), new)

    def visit(self, node: ast.AST) -> None:
        """Collect the changes of a node and of all below it that count."""
        if isinstance(node, ast.BinOp):
            self.operator(node.op, node.left, node.right)
        elif isinstance(node, ast.Compare) and len(node.ops) == 1:
            self.operator(node.ops[0], node.left, node.comparators[0])
        elif isinstance(node, ast.BoolOp) and len(node.values) == 2:
            self.operator(node.op, *node.values)
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.USub):
            self.add(self.span(node)[0], self.span(node.operand)[0], "")
        elif isinstance(node, ast.Constant) and isinstance(node.value, int | float):
            value, more = node.value, 1 if isinstance(node.value, int) else node.value or 1.0
            self.add(*self.span(node), repr(not value if isinstance(value, bool) else value + more))
        elif isinstance(node, ast.Call):
            self.arguments(node)
        if isinstance(node, ast.If | ast.While | ast.IfExp) and not self.is_guard(node):
            start, end = self.span(node.test)
            self.add(start, end, f"not ({self.data[start:end].decode()})")
        for child in _counting(node):
            self.visit(child)

    def is_guard(self, node: ast.If | ast.While | ast.IfExp) -> bool:
        """Return whether a condition refuses something, so that its opposite refuses everything."""
        refuses = isinstance(node, ast.If) and isinstance(node.body[0], ast.Raise)
        return refuses or "TYPE_CHECKING" in ast.unparse(node.test)

    def arguments(self, node: ast.Call) -> None:
        """Leave out one named argument; of a class it is a field, and most of those have no default."""
        name = ast.unparse(node.func).rpartition(".")[2]
        for keyword in node.keywords:
            if keyword.arg is None or keyword.arg in EQUAL or name[:1].isupper() or name == "replace":
                continue
            start, end = self.span(keyword)
            before = self.data[:start].rstrip()
            if before.endswith(b","):
                self.add(len(before) - 1, end, "")


def _counting(node: ast.AST) -> Iterator[ast.AST]:
    """The children of a node without annotations, decorators, messages and arguments that change nothing."""
    if isinstance(node, ast.Raise | ast.JoinedStr | ast.Import | ast.ImportFrom):
        return
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "msg", "type_params"):
            continue
        for child in value if isinstance(value, list) else [value]:
            said = isinstance(child, ast.keyword) and child.arg in EQUAL
            told = isinstance(child, ast.Call) and TOLD.search(ast.unparse(child.func))
            if isinstance(child, ast.AST) and not said and not told:
                yield child


def changes_of(root: Path, packages: Sequence[str]) -> list[Change]:
    """Return all changes of the Python files of packages (folders below ``root``), in order."""
    found = []
    for package in packages:
        folder = root / package / "src" if (root / package / "src").is_dir() else root / package
        for path in sorted(folder.rglob("*.py")):
            finder = _Finder(path.relative_to(root).as_posix(), path.read_bytes())
            finder.visit(ast.parse(finder.data))
            found += finder.found
    return found


def draw(root: Path, changes: Sequence[Change], count: int, seed: int) -> list[Change]:
    """Return ``count`` changes, each of another line: lines are equally likely, and so are the changes of a line."""
    lines: dict[tuple[str, int], list[Change]] = {}
    for change in changes:
        lines.setdefault((change.path, change.line), []).append(change)
    chance = random.Random(seed)
    drawn = (chance.choice(lines[line]) for line in chance.sample(sorted(lines), len(lines)))
    return list(islice((change for change in drawn if _parses(root, change)), count))


def _parses(root: Path, change: Change) -> bool:
    try:
        ast.parse(change.apply((root / change.path).read_bytes()))
    except SyntaxError:
        return False
    return True
