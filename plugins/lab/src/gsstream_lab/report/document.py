"""A report as a list of blocks, written as Markdown with image files and as one HTML page that needs nothing else."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from markdown_it import MarkdownIt

from gsstream.core.errors import OutputError
from gsstream.evaluation.summary import format_table


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of cells; the first row is the head. ``caption`` stands above."""

    caption: str
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True, slots=True)
class Picture:
    """An image file's bytes. ``name``: file name with its suffix. ``text``: what it shows, for those who cannot see."""

    name: str
    data: bytes
    text: str


#: A text is a paragraph or a heading ("## ...").
Block = str | Table | Picture
_TYPES = {".png": "image/png", ".jpg": "image/jpeg", ".webp": "image/webp"}
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 1180px; margin: 2em auto; padding: 0 1em }
h1 { font-size: 1.6em } h2 { font-size: 1.25em; margin-top: 2em; border-bottom: 1px solid #ddd }
table { display: block; overflow-x: auto; border-collapse: collapse; font-size: 13px; margin: 0.4em 0 1.2em }
th, td { padding: 3px 9px; white-space: nowrap; border-bottom: 1px solid #e6e6e6 }
img { max-width: 100%; height: auto; margin: 0.6em 0 }
"""


def write_report(title: str, blocks: Sequence[Block], out: Path) -> list[Path]:
    """Write ``report.html`` (self-contained), ``report.md`` and the images it names. Raises OutputError."""
    pictures = {out / block.name: block.data for block in blocks if isinstance(block, Picture)}
    pages = {"report.html": to_html(title, blocks), "report.md": to_markdown(title, blocks)}
    files = {out / name: text.encode() for name, text in pages.items()} | pictures
    try:
        out.mkdir(parents=True, exist_ok=True)
        for path, content in files.items():
            path.write_bytes(content)
    except OSError as error:
        raise OutputError(f"cannot write the report to {out}: {error}; choose another --out") from error
    return list(files)


def to_markdown(title: str, blocks: Sequence[Block]) -> str:
    """Return Markdown; pictures by their names."""
    return "\n\n".join([f"# {title}", *map(_text, blocks)]) + "\n"


def _text(block: Block) -> str:
    """A block as Markdown."""
    if isinstance(block, Table):
        rows = [[cell.replace("|", "\\|") for cell in row] for row in block.rows]
        return f"**{block.caption}**\n\n{format_table(rows)}"
    return f"![{block.text}]({block.name})" if isinstance(block, Picture) else block


def _img(picture: Picture) -> str:
    """A picture as HTML, with its bytes."""
    data = f"data:{_TYPES[Path(picture.name).suffix]};base64,{base64.b64encode(picture.data).decode()}"
    return f'<p><img src="{data}" alt="{html.escape(picture.text)}" /></p>\n'


def to_html(title: str, blocks: Sequence[Block]) -> str:
    """Return one page: styles and images inside, no script, nothing fetched."""
    # Descriptions and reasons are other people's text: what would be a link or a picture in Markdown stays text.
    markdown = MarkdownIt("commonmark", {"html": False}).enable("table").disable(["link", "autolink", "image"])
    parts = [_img(block) if isinstance(block, Picture) else markdown.render(_text(block)) for block in blocks]
    body = f"<h1>{html.escape(title)}</h1>\n{''.join(parts)}"
    head = f'<meta charset="utf-8"><title>{html.escape(title)}</title><style>{_STYLE}</style>'
    head += '<meta name="viewport" content="width=device-width">'
    return f'<!doctype html>\n<html lang="en"><head>{head}</head>\n<body>\n{body}</body></html>\n'
