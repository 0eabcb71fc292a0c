"""A page of headings, paragraphs, lists, tables and pictures, as Markdown and as one HTML file."""

import base64
import html
import io
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:  # slow to import
    from matplotlib.figure import Figure

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 64rem; margin: 2rem auto; padding: 0 1rem }
.wide { overflow-x: auto }
table { border-collapse: collapse; font-size: 0.9rem; font-variant-numeric: tabular-nums }
th, td { padding: 0.25rem 0.6rem; border-bottom: 1px solid #ccc; text-align: left }
img { max-width: 100% }
"""


class Heading(NamedTuple):
    """A heading of level 1, 2, …"""

    text: str
    level: int


class Paragraph(NamedTuple):
    """Plain text."""

    text: str


class Bullets(NamedTuple):
    """A list of plain texts."""

    items: Sequence[str]


class Table(NamedTuple):
    """Plain text in cells."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]

    def markdown(self) -> str:
        """As Markdown, a line a row."""
        rows = (self.header, *self.rows)
        lines = [[_line(cell).replace("|", "\\|") for cell in row] for row in rows]
        lines.insert(1, ["---"] * len(self.header))
        return "\n".join(
            "|" + "".join(f" {cell} |" if cell else " |" for cell in line) for line in lines
        )


class Picture(NamedTuple):
    """A figure, the name of its file without the suffix, and what it shows."""

    figure: "Figure"
    name: str
    text: str


Block = Heading | Paragraph | Bullets | Table | Picture


def markdown(blocks: Sequence[Block], pictures: bool = True) -> str:
    """The page as Markdown, which links to NAME.png for every picture, or leaves them out."""
    shown = [block for block in blocks if pictures or not isinstance(block, Picture)]
    return "\n\n".join(_markdown(block) for block in shown) + "\n"


def page(blocks: Sequence[Block]) -> str:
    """The page as HTML that needs no other file: the pictures are in it, as SVG."""
    title = next(block.text for block in blocks if isinstance(block, Heading))
    body = "\n".join(_html(block) for block in blocks)
    return (
        f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width">\n<title>{html.escape(title)}</title>'
        f"\n<style>{STYLE}</style>\n</head>\n<body>\n{body}\n</body>\n</html>\n"
    )


def picture_bytes(figure: "Figure", kind: str) -> bytes:
    """A figure as png or svg, the same bytes for the same figure."""
    import matplotlib

    file = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "mapg"}):
        metadata = {"Date": None} if kind == "svg" else None
        figure.savefig(file, format=kind, dpi=120, metadata=metadata)
    return file.getvalue()


def _markdown(block: Block) -> str:
    match block:
        case Heading(text, level):
            return f"{'#' * level} {_line(text)}"
        case Paragraph(text):
            return _without_tags(text)
        case Bullets(items):
            return "\n".join(f"- {_line(item)}" for item in items)
        case Table():
            return block.markdown()
        case Picture(_, name, text):
            return f"![{text}]({name}.png)\n\n{text}"


def _line(text: str) -> str:
    """A text that may come from a run folder, where a line is wanted."""
    return _without_tags(" ".join(text.splitlines()))


def _without_tags(text: str) -> str:
    """Markdown passes tags on to the browser, scripts among them; they are to be read instead."""
    return re.sub(r"<(?=[A-Za-z/!?])", "&lt;", text)


def _html(block: Block) -> str:
    match block:
        case Heading(text, level):
            return f"<h{level}>{html.escape(text)}</h{level}>"
        case Paragraph(text):
            return f"<p>{html.escape(text)}</p>"
        case Bullets(items):
            return f"<ul>{''.join(f'<li>{html.escape(item)}</li>' for item in items)}</ul>"
        case Table(header, rows):
            lines = [_cells("th", header), *(_cells("td", row) for row in rows)]
            return f'<div class="wide"><table>\n{chr(10).join(lines)}\n</table></div>'
        case Picture(figure, _, text):
            data = base64.b64encode(picture_bytes(figure, "svg")).decode()
            image = f'<img alt="{html.escape(text)}" src="data:image/svg+xml;base64,{data}">'
            return f"<figure>{image}<figcaption>{html.escape(text)}</figcaption></figure>"


def _cells(tag: str, cells: Sequence[str]) -> str:
    return f"<tr>{''.join(f'<{tag}>{html.escape(cell)}</{tag}>' for cell in cells)}</tr>"
