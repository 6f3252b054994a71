"""Draw sentences of docstrings, comments and pages, to be read as a stranger reads them.

Usage: python -m tools.sentences [--seed N] [--count N] [--where FOLDER ...]

Half are drawn from docstrings, three tenths from comments, two tenths from Markdown; a sentence has six words or more.
A sentence is unclear when a reader who knows the field, and not this repository, has to read it twice.
"""

from __future__ import annotations

import argparse
import ast
import io
import random
import re
import subprocess
import tokenize
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
#: Kind -> share of the sentences that are drawn.
SHARES = {"docstring": 0.5, "comment": 0.3, "page": 0.2}
WORDS = 6


class Sentence(NamedTuple):
    """One sentence, and where its paragraph begins."""

    path: str
    line: int
    text: str


def sentences_of(text: str) -> Iterator[str]:
    """Split prose into sentences of at least six words; a paragraph or an item of a list ends a sentence, too."""
    for block in re.split(r"\n\s*\n|\n\s*(?=[-*] |\d+\. |\||[a-z_]+(?:, [a-z_]+)*: )", text):
        for sentence in re.split(r"(?<=[.!?])\s+(?=[A-Z`*\"'(])", " ".join(block.split())):
            if len(sentence.split()) >= WORDS:
                yield sentence


def docstrings(path: str, code: str) -> Iterator[Sentence]:
    """Sentences of the docstrings of a module, its classes and functions."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            line = getattr(node, "lineno", 1)
            yield from (Sentence(path, line, text) for text in sentences_of(ast.get_docstring(node) or ""))


def comments(path: str, code: str) -> Iterator[Sentence]:
    """Sentences of comments; those on consecutive lines are one text, but for comments behind code."""
    begun, lines, last = 0, list[str](), -1
    tokens = [token for token in tokenize.generate_tokens(io.StringIO(code).readline) if token.type == tokenize.COMMENT]
    for token in tokens:
        behind = bool(token.line[: token.start[1]].strip())
        if lines and (behind or token.start[0] != last + 1):
            yield from (Sentence(path, begun, text) for text in sentences_of("\n".join(lines)))
            lines = []
        begun = begun if lines else token.start[0]
        lines.append(token.string.lstrip("#: "))
        last = -1 if behind else token.start[0]
    yield from (Sentence(path, begun, text) for text in sentences_of("\n".join(lines)))


def pages(path: str, text: str) -> Iterator[Sentence]:
    """Sentences of a Markdown page, without its code, tables and headings."""
    prose = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    prose = re.sub(r"^(\||#|\s*>|<).*$", "", prose, flags=re.MULTILINE)
    yield from (Sentence(path, 1, sentence) for sentence in sentences_of(prose))


def population(folders: Sequence[str]) -> dict[str, list[Sentence]]:
    """Return all sentences of tracked files below the folders, by kind, in the order of their paths."""
    found: dict[str, list[Sentence]] = {kind: [] for kind in SHARES}
    command = ["git", "ls-files", "--", *folders]
    for path in subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split():
        if not path.endswith((".py", ".md")) or not (ROOT / path).exists():
            continue
        text = (ROOT / path).read_text(encoding="utf-8")
        if path.endswith(".py"):
            found["docstring"] += docstrings(path, text)
            found["comment"] += comments(path, text)
        else:
            found["page"] += pages(path, text)
    return found


def draw(found: dict[str, list[Sentence]], seed: int, count: int) -> list[Sentence]:
    """Return ``count`` of these sentences, as many of each kind as its share says."""
    random.seed(seed)
    return [
        sentence
        for kind, share in SHARES.items()
        for sentence in random.sample(found[kind], min(round(share * count), len(found[kind])))
    ]


def main() -> None:
    """Print the sentences that the options ask for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--where", nargs="+", default=["gsstream", "plugins", "docs", "tools", "README.md"])
    args = parser.parse_args()
    for sentence in draw(population(args.where), args.seed, args.count):
        print(f"{sentence.path}:{sentence.line}: {sentence.text}")


if __name__ == "__main__":
    main()
