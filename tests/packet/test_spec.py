"""The pages of docs/spec: every MUST has an identifier of its own, and whoever cites one cites one that exists."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
SPEC = ROOT / "docs" / "spec"
DEFINED = re.compile(r"\[(R-\d+(?:\.\d+)?-\d+)\]")
CITED = re.compile(r"\bR-\d+(?:\.\d+)?-\d+\b")
#: Files in which a rule may be cited.
CITING = [
    "docs/**/*.md",
    "gsstream/**/*.py",
    "gsstream/web/**/*.js",
    "plugins/**/*.[chp]*",
    "tests/**/*.*",
    "tools/**/*.py",
]


def blocks(page: Path) -> Iterator[str]:
    """Paragraphs, points of lists and rows of tables."""
    for paragraph in page.read_text(encoding="utf-8").split("\n\n"):
        yield from re.split(r"\n(?= *(?:- |\d+\. |\|))", paragraph)


def rules() -> list[str]:
    """Identifiers in the order of the pages."""
    return [rule for page in sorted(SPEC.glob("*.md")) for rule in DEFINED.findall(page.read_text(encoding="utf-8"))]


def test_every_rule_has_an_identifier_of_its_own() -> None:
    found = rules()
    assert len(found) > 100
    assert sorted(found) == sorted(set(found))


def test_the_number_of_a_rule_is_that_of_its_section() -> None:
    for page in SPEC.glob("*.md"):
        section = ""
        for line in page.read_text(encoding="utf-8").splitlines():
            if line.startswith("#"):
                section = line.split()[1]
            for rule in DEFINED.findall(line):
                assert rule.split("-")[1] == section, (page.name, rule, section)


def test_every_must_has_an_identifier() -> None:
    bare = [
        f"{page.name}: {' '.join(block.split())[:100]}"
        for page in SPEC.glob("*.md")
        for block in blocks(page)
        if re.search(r"\bMUST\b", block) and not DEFINED.search(block)
    ]
    # The words themselves are explained once.
    assert [text for text in bare if "RFC 2119" not in text] == []


def test_rules_that_are_cited_exist() -> None:
    known = set(rules())
    files = {
        path
        for pattern in CITING
        for path in ROOT.glob(pattern)
        if path.suffix in (".md", ".py", ".js", ".mjs", ".json", ".c", ".h")
    }
    assert len(files) > 300
    unknown = {
        f"{path.relative_to(ROOT)}: {rule}"
        for path in files
        for rule in CITED.findall(path.read_text(encoding="utf-8"))
        if rule not in known
    }
    assert sorted(unknown) == []


def test_the_worked_examples_are_what_the_coder_makes_of_their_bytes() -> None:
    from gsstream.packet.symbols import decode_symbols

    text = (SPEC / "coder.md").read_text(encoding="utf-8")
    tables = re.findall(r"with the symbols ([-\d\s]+) is[^`]*`([0-9A-F\s]+)`", text)
    assert len(tables) == 2
    for symbols, data in tables:
        wanted = [int(symbol) for symbol in symbols.split()]
        assert decode_symbols(bytes.fromhex(data), len(wanted), 1)[:, 0].tolist() == wanted
