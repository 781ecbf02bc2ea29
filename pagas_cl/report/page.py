"""The page a person looks at: one HTML file with everything in it, and the pictures in full size beside it."""

from __future__ import annotations

import base64
import io
from html import escape
from pathlib import Path

from PIL import Image

from pagas_cl.report.pictures import css_gradient
from pagas_cl.scene.files import replaced

_THUMBNAIL = 480  # pixels, longer side of a picture inside the page
_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2em auto; max-width: 1500px; padding: 0 1em; color: #222 }
table { border-collapse: collapse; margin: 1em 0 } td, th { padding: .25em .8em; text-align: right }
td:first-child, th:first-child { text-align: left } tr:nth-child(even) { background: #f3f3f3 }
.pictures { display: flex; flex-wrap: wrap; gap: 1em } figure { margin: 0; width: 340px }
figure img { width: 100%; display: block } figcaption { font-size: 13px }
.legend { font-size: 13px; color: #555; margin: .3em 0 }
.strip { height: 6px; margin: 3px 0 } h2 { margin-top: 2em } body > img { max-width: 100% }
tr.marked, tr.marked:nth-child(even) { background: #e6f2e6; font-weight: 600 }
"""


def write_picture(path: Path, pixels) -> None:
    """Write a picture beside its name and rename it; the suffix says the kind."""
    with replaced(path, path.suffix) as beside:
        Image.fromarray(pixels).save(beside, **({"quality": 92} if path.suffix == ".jpg" else {}))


def figure(picture, link: str) -> str:
    """HTML of one picture with its legend: a small copy in the page, a link to the full size."""
    strip = f'<div class="strip" style="background:{css_gradient(picture.map_name)}"></div>' if picture.map_name else ""
    return (f'<figure><a href="{escape(link)}"><img src="{_embedded(picture.pixels)}" alt="{escape(picture.title)}">'
            f"</a>{strip}<figcaption><b>{escape(picture.title)}</b> {escape(picture.legend)}</figcaption></figure>")


def html_page(title: str, notes: list[str], header: list[str], rows: list[list[str]], sections: list[tuple] = (),
              legend: list[str] = (), picture: str = "", marked=()) -> str:
    """The whole page: `notes` below the title, an image `picture`, a table, below it its `legend`, then the sections.

    A section is (name, pictures as HTML, lines of text); a row whose first cell names one leads there. Rows that are
    `marked` stand out.
    """
    parts = [f'<!doctype html><html lang="en"><meta charset="utf-8">'
             f'<meta name="generator" content="pagas-cl"><title>{escape(title)}</title>'
             f"<style>{_STYLE}</style><h1>{escape(title)}</h1>", _paragraphs(notes)]
    if picture:
        parts.append(f'<img src="{escape(picture)}" alt="{escape(title)}">')
    linked = {name for name, *_ in sections}
    parts.append("<table>" + _row("th", header))
    parts += [_row("td", row, row[0] in linked, k < len(marked) and marked[k]) for k, row in enumerate(rows)]
    parts += ["</table>", _paragraphs(legend, ' class="legend"')]
    for name, figures, remarks in sections:
        parts += [f'<h2 id="{escape(name)}">{escape(name)}</h2>', _paragraphs(remarks),
                  f'<div class="pictures">{"".join(figures)}</div>']
    return "\n".join(parts) + "\n</html>\n"


def _paragraphs(lines, kind: str = "") -> str:
    return "\n".join(f"<p{kind}>{escape(line)}</p>" for line in lines)


def _row(tag: str, row: list[str], linked: bool = False, marked: bool = False) -> str:
    cells = [escape(cell) for cell in row]
    if linked:
        cells[0] = f'<a href="#{cells[0]}">{cells[0]}</a>'
    kind = ' class="marked"' if marked else ""
    return f"<tr{kind}>" + "".join(f"<{tag}>{cell}</{tag}>" for cell in cells) + "</tr>"


def _embedded(pixels) -> str:
    """A small JPEG of the picture as a data address."""
    image = Image.fromarray(pixels)
    image.thumbnail((_THUMBNAIL, _THUMBNAIL))
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=85)
    return f"data:image/jpeg;base64,{base64.b64encode(buffer.getvalue()).decode()}"
