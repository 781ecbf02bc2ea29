"""The page a person looks at: one HTML file with everything in it, and a folder of the pictures in full size."""

import base64
import io
from html import escape
from importlib.resources import files
from urllib.parse import quote

from PIL import Image

from pagas_cl.app.report.pictures import css_gradient
from pagas_cl.scene.own_files import TEXT_MARK

_LONG = 24        # letters, from which on a column of a table holds sentences
_THUMBNAIL = 480  # pixels, longer side of a picture inside the page


def figure(picture, link: str, large: bool = False) -> str:
    """HTML of one picture with its legend: a small copy in the page, a link to the full size."""
    return (f'<figure{" class=large" * large}><a href="{_address(link)}">{_image(picture, link)}</a>'
            f"{_strip(picture)}<figcaption><b>{escape(picture.title)}</b> {escape(picture.legend)}"
            "</figcaption></figure>")


def compared(before, after, links: tuple[str, str]) -> str:
    """HTML of two pictures of one size over each other, with a slider between them; the legend is of `after`."""
    title = after.title.removesuffix(" after")
    full = ", ".join(f'<a href="{_address(link)}">{when}</a>' for link, when in zip(links, ("before", "after")))
    return (f'<figure class="large"><div class="pair">{_image(after, links[1])}{_image(before, links[0], "over")}'
            f'{slider(f"{title}: share of the picture that shows what was before")}</div>{_strip(after)}'
            f"<figcaption><b>{escape(title)}</b> {escape(after.legend)} (full size: {full})</figcaption></figure>")


def slider(label: str) -> str:
    """HTML of the line between before and after, and what moves it."""
    return ('<span class="tag">before</span><span class="tag right">after</span><i class="line"></i>'
            f'<input type="range" min="0" max="100" step="0.1" value="50" aria-label="{escape(label)}">')


def html_page(title: str, notes: list[str], header: list[str], rows: list[list[str]], sections: list[tuple] = (),
              legend: list[str] = (), picture: str = "", marked=(), *, headline: str = "", facts=(), lead: str = "",
              body: str = "", closing: list[str] = (), scripts: list[str] = (), details: str = "") -> str:
    """The whole page, all text escaped but for `lead`, `details`, `body` and the pictures of sections, which are HTML.

    From the top: `headline`, one sentence; `lead`; `facts`, pairs of a word and a text; `notes`; `details` (folded);
    `body`; an image `picture`; a table, `legend` below it; the sections; `closing` lines. A section is (name, pictures
    as HTML, lines of text, more of them that are folded); a row whose first cell names one leads there. Rows that are
    `marked` stand out. `scripts` of this package run at the end.
    """
    parts = [f'<!doctype html><html lang="en"><meta charset="utf-8"><meta name="generator" content="{TEXT_MARK}">'
             '<meta name="viewport" content="width=device-width, initial-scale=1">'
             f"<title>{escape(title)}</title><style>{_shipped('page.css')}</style><h1>{escape(title)}</h1>"]
    parts += [f'<p class="headline">{escape(headline)}</p>'] if headline else []
    parts.append(lead)
    parts += [pairs(facts), paragraphs(notes), details, body]
    if picture:
        parts.append(f'<div class="wide"><img src="{_address(picture)}" alt="{escape(title)}"></div>')
    places = {name: f"section-{k}" for k, (name, *_) in enumerate(sections)}
    if rows:
        long = [k for k, column in enumerate(zip(*rows)) if max(map(len, column)) > _LONG and k]
        parts.append('<div class="wide"><table>' + _row("th", header, long))
        parts += [_row("td", row, long, places.get(row[0], ""), k < len(marked) and marked[k], header)
                  for k, row in enumerate(rows)]
        parts.append("</table></div>")
    parts.append(paragraphs(legend, ' class="legend"'))
    for name, figures, remarks, more in sections:
        parts += [f'<h2 id="{places[name]}">{escape(name)}</h2>', paragraphs(remarks),
                  folded("What was measured of this view", paragraphs(more)),
                  f'<div class="pictures">{"".join(figures)}</div>']
    parts.append(paragraphs(closing))
    parts += [f"<script>{_shipped(name)}</script>" for name in scripts]
    return "\n".join(part for part in parts if part) + "\n</html>\n"


def _shipped(name: str) -> str:
    return files("pagas_cl.app.report").joinpath(name).read_text("utf-8")


def pairs(facts) -> str:
    texts = [(word, f"<code>{escape(text)}</code>" if word == "command" else escape(text)) for word, text in facts]
    rows = "".join(f"<dt>{escape(word)}</dt><dd>{text}</dd>" for word, text in texts)
    return f'<dl class="facts">{rows}</dl>' if rows else ""


def paragraphs(lines, kind: str = "") -> str:
    return "\n".join(f"<p{kind}>{escape(line)}</p>" for line in lines)


def folded(summary: str, content: str) -> str:
    """HTML of `content`, HTML itself, that a click on the `summary` shows; nothing where it is empty."""
    return f"<details><summary>{escape(summary)}</summary>{content}</details>" if content else ""


def _row(tag: str, row: list[str], long: list[int], place: str = "", marked: bool = False, header=()) -> str:
    """A row of the table; columns `long` hold sentences. Cells carry the `header`'s names, for narrow screens."""
    cells = [escape(cell) for cell in row]
    if place:
        cells[0] = f'<a href="#{place}">{cells[0]}</a>'
    kind = ' class="marked"' if marked else ""
    names = [f' data-name="{escape(name)}"' for name in header] or [""] * len(row)
    return f"<tr{kind}>" + "".join(f"<{tag}{' class=long' * (k in long)}{name}>{cell}</{tag}>"
                                   for k, (cell, name) in enumerate(zip(cells, names))) + "</tr>"


def _address(name: str) -> str:
    return escape(quote(name))


def _strip(picture) -> str:
    return f'<div class="strip" style="background:{css_gradient(picture.map_name)}"></div>' if picture.map_name else ""


def _image(picture, link: str, kind: str = "") -> str:
    """A small JPEG of the picture inside the page; the page's script puts the one at `link` in its place."""
    image = Image.fromarray(picture.pixels)
    width, height = image.size
    image.thumbnail((_THUMBNAIL, _THUMBNAIL))
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=85)
    data = base64.b64encode(buffer.getvalue()).decode()
    return (f'<img{f" class={kind}" if kind else ""} src="data:image/jpeg;base64,{data}" data-full="{_address(link)}" '
            f'width="{width}" height="{height}" alt="{escape(picture.title)}" draggable="false">')
