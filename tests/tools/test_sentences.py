"""Sentences that are drawn to be read: which there are, and that a seed decides which are drawn."""

from __future__ import annotations

from tools.sentences import SHARES, comments, docstrings, draw, pages, population

CODE = '''"""A module that holds one short function. Short."""


def one() -> int:
    """Return the number one, whatever the weather is. It is

    never two, and here is a list that says so:

    - the first item of this list is a sentence
    """
    # A comment that goes on over two lines is one
    # sentence all the same.
    one = 1  # a comment behind code is a text of its own
    two = 2  # short
    return one
'''
PAGE = """# A heading of more than six words is none

A page has sentences, too. One of them is long enough
for this.

```
code is not prose, however many words it has
```

| a table is none, whatever its many cells say |
"""


def test_what_counts_as_a_sentence() -> None:
    assert [sentence.text for sentence in docstrings("a.py", CODE)] == [
        "A module that holds one short function.",
        "Return the number one, whatever the weather is.",
        "never two, and here is a list that says so:",
        "- the first item of this list is a sentence",
    ]
    comment, behind = comments("a.py", CODE)
    assert behind.text == "a comment behind code is a text of its own"
    assert comment.text == "A comment that goes on over two lines is one sentence all the same."
    assert comment.line == 11
    (page,) = pages("a.md", PAGE)
    assert page.text == "One of them is long enough for this."


def test_a_seed_decides_what_is_drawn() -> None:
    found = population(["tools"])
    assert draw(found, 3, 10) == draw(found, 3, 10) != draw(found, 4, 10)
    assert len(draw(population(["tools", "docs/flow.md"]), 3, 10)) == 10
    assert sum(SHARES.values()) == 1
