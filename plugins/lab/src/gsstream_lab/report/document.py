"""A report as a list of blocks, written as Markdown with image files or as one HTML page that needs nothing else."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gsstream.core.errors import OutputError
from gsstream.evaluation.summary import format_table


@dataclass(frozen=True, slots=True)
class Heading:
    """Level 1 to 3."""

    text: str
    level: int = 2


@dataclass(frozen=True, slots=True)
class Text:
    """A paragraph of plain text."""

    text: str


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


Block = Heading | Text | Table | Picture
_TYPES = {".png": "image/png", ".jpg": "image/jpeg", ".webp": "image/webp"}
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 1180px; margin: 2em auto; padding: 0 1em }
h1 { font-size: 1.6em } h3 { font-size: 1.05em }
h2 { font-size: 1.25em; margin-top: 2em; border-bottom: 1px solid #ddd }
.table { overflow-x: auto } table { border-collapse: collapse; font-size: 13px; margin: 0.4em 0 1.2em }
th, td { padding: 3px 9px; text-align: right; white-space: nowrap; border-bottom: 1px solid #e6e6e6 }
th:first-child, td:first-child { text-align: left } th { border-bottom: 1px solid #888; font-weight: 600 }
tr:hover td { background: #f5f7fa } p.caption { margin: 1em 0 0; font-weight: 600; font-size: 14px }
img { max-width: 100%; height: auto; margin: 0.6em 0 }
"""


def write_report(title: str, blocks: Sequence[Block], out: Path) -> list[Path]:
    """Write ``report.html`` (self-contained), ``report.md`` and the images it names. Raises OutputError."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        written = [out / "report.html", out / "report.md"]
        written[0].write_text(to_html(title, blocks), encoding="utf-8")
        written[1].write_text(to_markdown(title, blocks), encoding="utf-8")
        for block in blocks:
            if isinstance(block, Picture):
                (out / block.name).write_bytes(block.data)
                written.append(out / block.name)
    except OSError as error:
        raise OutputError(f"cannot write the report to {out}: {error}; choose another --out") from error
    return written


def to_markdown(title: str, blocks: Sequence[Block]) -> str:
    """Return Markdown; pictures by their names."""
    parts = [f"# {title}"]
    for block in blocks:
        if isinstance(block, Heading):
            parts.append(f"{'#' * block.level} {block.text}")
        elif isinstance(block, Text):
            parts.append(block.text)
        elif isinstance(block, Table):
            rows = [[cell.replace("|", "\\|") for cell in row] for row in block.rows]
            parts.append(f"**{block.caption}**\n\n{format_table(rows)}")
        else:
            parts.append(f"![{block.text}]({block.name})")
    return "\n\n".join(parts) + "\n"


def to_html(title: str, blocks: Sequence[Block]) -> str:
    """Return one page: styles and images inside, no script, nothing fetched."""
    parts = [f"<h1>{html.escape(title)}</h1>"]
    for block in blocks:
        if isinstance(block, Heading):
            parts.append(f"<h{block.level}>{html.escape(block.text)}</h{block.level}>")
        elif isinstance(block, Text):
            parts.append(f"<p>{html.escape(block.text)}</p>")
        elif isinstance(block, Table):
            parts.append(_table(block))
        else:
            data = base64.b64encode(block.data).decode()
            kind = _TYPES[Path(block.name).suffix]
            parts.append(f'<img alt="{html.escape(block.text)}" src="data:{kind};base64,{data}">')
    head = f'<meta charset="utf-8"><title>{html.escape(title)}</title><style>{_STYLE}</style>'
    head += '<meta name="viewport" content="width=device-width">'
    body = "\n".join(parts)
    return f'<!doctype html>\n<html lang="en"><head>{head}</head>\n<body>\n{body}\n</body></html>\n'


def _table(block: Table) -> str:
    head, *rows = ([html.escape(cell) for cell in row] for row in block.rows)
    lines = ["<tr>" + "".join(f"<th>{cell}</th>" for cell in head) + "</tr>"]
    lines += ["<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows]
    caption = f'<p class="caption">{html.escape(block.caption)}</p>'
    return f'{caption}<div class="table"><table>{"".join(lines)}</table></div>'
