"""The form of docstrings: a sentence with a verb first, arguments by name, no word that only insiders understand."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
LIBRARY = sorted((ROOT / "gsstream").rglob("*.py"))

#: The words with which a function may say what it does. A new one is added here when a sentence needs it.
VERBS = """
Add Advance Append Apply Ask Average Begin Build Call Cancel Change Check Choose Clone Close Collect Come Compare
Composite Compute Concatenate Continue Convert Copy Count Cut Decode Decorate Discover Do Draw Drop Encode End
Enter Evaluate Fill Find Fit Fold Forget Freeze Give Go Group Grow Hold Import Join Judge Keep Kill Lay Leave Let
List Look Make Map Match Measure Merge Minimise Move Name Note Open Parse Place Plan Play Precompute Print Project
Propose Pull Put Quantise Raise Ray-cast Read Reconstruct Record Refuse Register Release Remove Render Reorder
Replace Resolve Return Run Save Say See Select Send Serve Shift Show Sort Split Stack Start Stop Sum Summarise Take Tell
Time Triangulate Try Turn Update Use Validate Verify Wait Walk Write Yield
"""
#: The start of a noun phrase that describes a class or a property fully: a capital, a shape, a name, a number, a quote.
NOUN_PHRASE = re.compile(r"""[A-Z\[(`"0-9]""")
#: Functions with as many parameters as this name them all under ``Arguments:``.
MANY = 3
#: Where they need not: commands describe their options where these are declared, and one file has no line left.
UNEXPLAINED = ("gsstream/cli/", "gsstream/trade/bench/frame.py")


class Documented(NamedTuple):
    """A public class, function or property with a docstring of its own."""

    path: str
    name: str
    node: ast.ClassDef | ast.FunctionDef
    doc: str

    @property
    def place(self) -> str:
        return f"{self.path}:{self.node.lineno}: {self.name}"

    @property
    def is_property(self) -> bool:
        return any("property" in ast.unparse(mark) for mark in getattr(self.node, "decorator_list", ()))

    @property
    def parameters(self) -> list[str]:
        if isinstance(self.node, ast.ClassDef):
            return []
        given = self.node.args
        names = [arg.arg for arg in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
        return [name for name in names if name not in ("self", "cls")]


def documented(path: Path) -> Iterator[Documented]:
    """Public names of a module and of its public classes, where they have a docstring of their own."""

    def walk(node: ast.Module | ast.ClassDef) -> Iterator[Documented]:
        for child in node.body:
            if isinstance(child, ast.ClassDef | ast.FunctionDef) and not child.name.startswith("_"):
                doc = ast.get_docstring(child)
                if doc:
                    yield Documented(path.relative_to(ROOT).as_posix(), child.name, child, doc)
            if isinstance(child, ast.ClassDef) and not child.name.startswith("_"):
                yield from walk(child)

    yield from walk(ast.parse(path.read_text(encoding="utf-8")))


EVERYTHING = [one for path in LIBRARY for one in documented(path)]


def does_something(one: Documented) -> bool:
    return isinstance(one.node, ast.FunctionDef) and not one.is_property


def starts_well(one: Documented) -> bool:
    """Functions begin with a verb, checks of the kit state what must be true, classes and properties what they are."""
    line = one.doc.splitlines()[0]
    if does_something(one) and not one.name.startswith("check_"):
        return line.split()[0].rstrip(",") in VERBS.split()
    return NOUN_PHRASE.match(line) is not None


def undocumented_arguments(one: Documented) -> list[str]:
    """Parameters that the section ``Arguments:`` of a function leaves out; all when there is none."""
    section = re.search(r"^Arguments:\n((?:    .*\n?|\n)*)", one.doc + "\n", re.MULTILINE)
    named = re.findall(r"(?:^    |[.;] )((?:\w+, )*\w+):", section.group(1) if section else "", re.MULTILINE)
    known = {name for names in named for name in names.split(", ")}
    return [name for name in one.parameters if name not in known]


def test_the_library_was_found() -> None:
    assert len(LIBRARY) > 200
    assert len(EVERYTHING) > 1000


def test_the_first_line_is_a_whole_sentence() -> None:
    assert [one.place for one in EVERYTHING if not one.doc.splitlines()[0].endswith(".")] == []


def test_functions_begin_with_a_verb_and_nouns_with_a_phrase() -> None:
    assert [f"{one.place}: {one.doc.splitlines()[0]}" for one in EVERYTHING if not starts_well(one)] == []


def test_functions_of_many_parameters_name_them_all() -> None:
    rooms = [one for one in EVERYTHING if not one.path.startswith(UNEXPLAINED)]
    many = [one for one in rooms if does_something(one) and len(one.parameters) >= MANY]
    assert [f"{one.place}: {left}" for one in many if (left := undocumented_arguments(one))] == []
    assert len(many) > 200


def test_nothing_is_called_ours() -> None:
    """The attribute ``source`` of a part says where it is from; elsewhere the word says nothing to a stranger."""
    found = [
        f"{path.relative_to(ROOT)}:{number}"
        for path in LIBRARY
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if re.search(r"\(ours\)|; ours\)|[,.] [Oo]urs[.:]", line)
    ]
    assert found == []


#: A sentence that keeps the rule, and those that break it in every way: the test itself is tested.
GOOD = "def f(a, b, c):\n    '''Return a sum.\n\n    Arguments:\n        a, b: terms.\n        c: another.\n    '''\n"
BAD = {
    "no verb": "def f(a):\n    '''The sum.'''\n",
    "no sentence": "def f(a):\n    '''Return the sum'''\n",
    "no arguments": "def f(a, b, c):\n    '''Return a sum.'''\n",
}


def only(text: str) -> Documented:
    (node,) = ast.parse(text).body
    assert isinstance(node, ast.FunctionDef)
    return Documented("x.py", node.name, node, ast.get_docstring(node) or "")


def test_the_rules_tell_good_from_bad() -> None:
    assert starts_well(only(GOOD))
    assert undocumented_arguments(only(GOOD)) == []
    assert not starts_well(only(BAD["no verb"]))
    assert not only(BAD["no sentence"]).doc.endswith(".")
    assert undocumented_arguments(only(BAD["no arguments"])) == ["a", "b", "c"]
