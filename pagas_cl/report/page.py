"""The page a person looks at: one HTML file with everything in it, and the pictures in full size beside it."""

from __future__ import annotations

import base64
import io
import os
from html import escape
from pathlib import Path

from PIL import Image

from pagas_cl.report.colors import css_gradient

_THUMBNAIL = 480  # pixels, longer side of a picture inside the page
_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2em auto; max-width: 1500px; padding: 0 1em; color: #222 }
table { border-collapse: collapse; margin: 1em 0 } td, th { padding: .25em .8em; text-align: right }
td:first-child, th:first-child { text-align: left } tr:nth-child(even) { background: #f3f3f3 }
.pictures { display: flex; flex-wrap: wrap; gap: 1em } figure { margin: 0; width: 340px }
figure img { width: 100%; display: block } figcaption { font-size: 13px }
.legend { font-size: 13px; color: #555; margin: .3em 0 }
.strip { height: 6px; margin: 3px 0 } h2 { margin-top: 2em }
"""


def write_picture(path: Path, pixels) -> None:
    """Write a picture beside its name and rename it; the suffix says the kind."""
    beside = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        Image.fromarray(pixels).save(beside, **({"quality": 92} if path.suffix == ".jpg" else {}))
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write text beside its name and rename it."""
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        beside.write_text(text, encoding="utf-8")
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)


def figure(picture, link: str) -> str:
    """HTML of one picture with its legend: a small copy in the page, a link to the full size."""
    strip = f'<div class="strip" style="background:{css_gradient(picture.map_name)}"></div>' if picture.map_name else ""
    return (f'<figure><a href="{escape(link)}"><img src="{_embedded(picture.pixels)}" alt="{escape(picture.title)}">'
            f"</a>{strip}<figcaption><b>{escape(picture.title)}</b> {escape(picture.legend)}</figcaption></figure>")


def html_page(title: str, notes: list[str], header: list[str], rows: list[list[str]], sections: list[tuple],
              legend: list[str] = ()) -> str:
    """The whole page.

    Parameters
    ----------
    notes : list of str
        Lines below the title.
    header, rows : list of str, list of list of str
        The table, one row a view.
    sections : list of (name, figures, remarks)
        A view's pictures as HTML, and lines of text.
    legend : list of str
        Lines below the table.
    """
    parts = [f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{escape(title)}</title>'
             f"<style>{_STYLE}</style><h1>{escape(title)}</h1>"]
    parts += [f"<p>{escape(note)}</p>" for note in notes]
    parts.append(_table(header, rows))
    parts += [f'<p class="legend">{escape(line)}</p>' for line in legend]
    for name, figures, remarks in sections:
        parts.append(f'<h2 id="{escape(name)}">{escape(name)}</h2>')
        parts += [f"<p>{escape(remark)}</p>" for remark in remarks]
        parts.append(f'<div class="pictures">{"".join(figures)}</div>')
    return "\n".join(parts) + "\n</html>\n"


def _table(header: list[str], rows: list[list[str]]) -> str:
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    body = "".join(f'<tr><td><a href="#{escape(row[0])}">{escape(row[0])}</a></td>'
                   + "".join(f"<td>{escape(cell)}</td>" for cell in row[1:]) + "</tr>" for row in rows)
    return f"<table><tr>{head}</tr>{body}</table>"


def _embedded(pixels) -> str:
    """A small JPEG of the picture as a data address."""
    image = Image.fromarray(pixels)
    image.thumbnail((_THUMBNAIL, _THUMBNAIL))
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=85)
    return f"data:image/jpeg;base64,{base64.b64encode(buffer.getvalue()).decode()}"
