"""Collects the views of a run as they are done, and writes the pictures and the page."""

import json
from pathlib import Path

import numpy as np

from pagas_cl.report.page import figure, html_page, write_picture
from pagas_cl.report.pictures import change_in_units, parallax_change, view_pictures
from pagas_cl.scene.files import write_text
from pagas_cl.scene.names import flat_stem

LEGEND = ["Pixels: refined = moved by the photos; kept = the input stays, since no other photo sees the pixel, it is "
          "masked out, or the whole view came back as it came; rejected = the input stays, since the photos speak "
          "against the new depth; no surface = no depth to start from.",
          "Change: how far the surface moved as the other photos see it, in pixels of parallax (px). Confidence: 1 = "
          "the photos fix the depth, 0.5 = they fix it to one pixel of parallax, 0 = they say nothing.",
          "Pictures: click for full size; dark grey = no value; the strip below a picture is its scale, from left to "
          "right."]


class Report:
    """A folder with `index.html`, `report.json` and, for every view, `<view>_<picture>.png` (the photo as .jpg).

    Used as a context manager, so that an interrupted run has a page of what was done. The folder is made, files of the
    same names are replaced; `notes` are lines below the title.
    """

    def __init__(self, folder, title: str = "pagas_cl", notes=()):
        self.folder = Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        self.title, self.notes = title, list(notes)
        self._views: list[dict] = []
        self._sections: list[tuple] = []
        self._stems: list[str] = []

    def __enter__(self) -> "Report":
        return self

    def __exit__(self, *_):
        self.write()

    def add(self, view, before, after, *, contexts=(), parallax=None, confidence=None, counts=None, remarks=()) -> None:
        """Write the pictures of one View (maps as in `view_pictures`) and remember its row of the table.

        The change is measured by the Cameras `contexts` (`parallax_change`), or by `parallax` (H, W), the change of
        depth that is one pixel of parallax, 0 = unknown; without either of them there is no picture of it. `counts` are
        columns of the table, `remarks` lines above the pictures.
        """
        photo, camera = view.load_image(), view.camera
        change = parallax_change(camera, list(contexts), before, after) if contexts else None
        if parallax is not None:
            change = change_in_units(before, after, parallax)
        stem = flat_stem(view.name, self._stems)
        self._stems.append(stem)
        figures = []
        for picture in view_pictures(photo, camera, before, after, change=change, confidence=confidence):
            name = f"{stem}_{picture.key}.{'jpg' if picture.key == 'photo' else 'png'}"
            write_picture(self.folder / name, picture.pixels)
            figures.append(figure(picture, name))
        self._views.append({"view": view.name, **(counts or {}), **_change_figures(change, confidence, after)})
        self._sections.append((view.name, figures, list(remarks)))

    def note(self, text: str) -> None:
        self.notes.append(text)

    def write(self) -> Path:
        """Write the page and the numbers; returns the page's path."""
        columns = list(dict.fromkeys(key for row in self._views for key in row)) or ["view"]
        rows = [[_cell(row.get(key)) for key in columns] for row in self._views]
        content = {"notes": self.notes, "views": self._views}
        write_text(self.folder / "report.json", json.dumps(content, indent=1) + "\n")
        legend = LEGEND if self._views else []
        return write_text(self.folder / "index.html",
                          html_page(self.title, self.notes, columns, rows, self._sections, legend))


def _change_figures(change, confidence, after) -> dict:
    figures = {}
    if change is not None and np.isfinite(change).any():
        moved = np.abs(change[np.isfinite(change)])
        figures["median change (px)"] = round(float(np.median(moved)), 4)
        figures["95% change (px)"] = round(float(np.percentile(moved, 95)), 4)
    if confidence is not None and (np.asarray(after) > 0).any():
        figures["mean confidence"] = round(float(np.asarray(confidence)[np.asarray(after) > 0].mean()), 4)
    return figures


def _cell(value) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.4g}"
    return f"{value:,}" if isinstance(value, int) else str(value)
