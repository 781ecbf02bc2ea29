"""Writes pictures and page of a run's views as they are done, and says in a sentence each what it gained and did."""

import time
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from pagas_cl.app.report.mesh_view import SCRIPTS, mesh_viewer
from pagas_cl.app.report.page import compared, figure, folded, html_page, pairs, paragraphs
from pagas_cl.app.report.pictures import change_in_units, shaded_pictures, view_pictures
from pagas_cl.method.effects.decide import Decision
from pagas_cl.scene.check.reasons import commonest
from pagas_cl.scene.images import write_image
from pagas_cl.scene.names import flat_stem
from pagas_cl.scene.own_files import write_json
from pagas_cl.system.files import write_text

LEGEND = ["Of the surface to start from: refined = moved by the photos; kept = unchanged, since no other photo sees "
          "it, it is masked out, the photos show nothing there, or the whole view is unchanged; rejected = unchanged, "
          "since the photos contradict the new depth. No surface: share of the whole photo. report.json counts the "
          "pixels.",
          "Change: how far the surface moved as the other photos see it, in their pixels (px): half of it by more than "
          "the median. Confidence: 1 = the photos fix the depth, 0.5 = to one pixel, 0 = they say nothing.",
          "Pictures: click for full size; dark grey = no value; the strip below a picture is its scale, from left to "
          "right."]
_NO_MESH_BEFORE = ("There is no mesh before: the run began with depth maps. They are shown before and after, view by "
                   "view, below.")
_MESH = "mesh"
_OF_A_VIEW = ("photo.jpg", "depth_before.png", "depth_after.png", "normals_before.png", "normals_after.png",
              "change.png", "confidence.png", "camera.png")
_OF_MESHES = ("photo.jpg", "shaded_before.png", "shaded_after.png")
STATUS = ("refined", "kept", "rejected")   # of pixels with a surface
_NOT_MEASURED = "Whether photos agree better was not measured"


def picture_files(names, meshes: bool = False) -> list[str]:
    """Names of the pictures that a Report of these views has, and of two meshes."""
    stems = [_MESH]
    for name in dict.fromkeys(names):
        stems.append(flat_stem(name, stems))
    return [f"{stem}_{key}" for stem in stems[not meshes:] for key in (_OF_MESHES if stem == _MESH else _OF_A_VIEW)]


class Report:
    """A folder with `index.html`, `report.json` and, for every view, `<view>_<picture>.png` (the photo as .jpg).

    A context manager, so that an interrupted run has a page of what was done. The folder is made, files of the same
    names are replaced. `notes`: lines below the title; `facts`: pairs of a word and a text; folded away are
    `particulars`, more such pairs, and `details`, lines of what was measured. `began`: time.monotonic() at the start of
    the run. `hold_out`: names of photos that were kept out of everything, as a shell takes them.
    """

    def __init__(self, folder, title: str = "pagas_cl", notes=(), facts=(), *, particulars=(),
                 began: float | None = None, hold_out: str = ""):
        self.folder = Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        self.title, self.notes, self.facts = title, list(notes), list(facts)
        self.particulars, self.details = list(particulars), list[str]()
        self._views: list[dict] = []
        self._reasons: list[str] = []
        self._reports: list[dict] = []
        self._sections: list[tuple] = []
        self._stems = [_MESH]
        self._mesh, self._stopped, self._began, self.hold_out = "", "", began, hold_out

    def __enter__(self) -> "Report":
        return self

    def __exit__(self, kind, error, _):
        if kind is not None:
            self._stopped = "interrupted" if kind is KeyboardInterrupt else str(error) or kind.__name__
        self.write()

    def add(self, view, before, result, given=None) -> None:
        """Write the pictures of one View and remember its row of the table: `before` is its initial z-depth (H, W), 0 =
        no surface, `result` its DepthResult, `given` its Camera before cameras were refined."""
        change = change_in_units(before, result.depth, result.parallax)
        confidence = result.confidence
        stem = flat_stem(view.name, self._stems)
        self._stems.append(stem)
        pictures = view_pictures(view.load_image(), view.camera, before, result.depth, change=change,
                                 confidence=confidence, given=None if given is view.camera else given)
        figures = self._figures(stem, pictures)
        found = result.report
        seconds = {"seconds": round(found["seconds"], 2)} if "seconds" in found else {}
        self._views.append({"view": view.name, **result.counts, **seconds,
                            **_change_figures(change, confidence, result.depth)})
        self._reasons.append(result.reason)
        self._reports.append(found)
        remarks = [f"unchanged: {result.reason}"] if result.reason else []
        if found.get("contexts"):
            remarks.append("compared with the photos: " + ", ".join(found["contexts"]))
        details = []
        for on, what in ((True, "effects simulated"), (False, "effects not needed")):
            effects = [str(Decision(**fields)) for fields in found.get("effects", ()) if fields["on"] == on]
            details += [f"{what}: " + "; ".join(effects)] if effects else []
        self._sections.append((view.name, figures, remarks, details))

    def add_mesh(self, before, after, *, view=None, depths=None) -> None:
        """Show two meshes (see `mesh_viewer`) at the head of the page.

        `view`: from where they are seen at first. `depths`: of both, (H, W) z-depth there, for shaded pictures.
        """
        html = mesh_viewer(before, after, camera=view and view.camera)
        figures = self._figures(_MESH, shaded_pictures(view, *depths)) if depths is not None else []
        absent = paragraphs([] if before is not None else [_NO_MESH_BEFORE])
        self._mesh = f'<h2>mesh</h2>{html}{absent}<div class="pictures">{"".join(figures)}</div>'

    def write(self) -> Path:
        columns = list(dict.fromkeys(key for row in self._views for key in row)) or ["view"]
        total = {"view": f"all {len(self._views)} views", **summed(self._views)} if len(self._views) > 1 else {}
        rows = [_cells(row, columns) for row in (*self._views, *([total] if len(total) > 1 else []))]
        proven, done = proof(self._reports, self._reasons, self.hold_out), sentence(self._views, self._reasons,
                                                                                    self._stopped)
        headline, second = (proven, done) if proven and not proven.startswith(_NOT_MEASURED) else (done, proven)
        notes = [second, *self.notes] if second else self.notes
        facts = list(self.facts)
        if self._began is not None:
            facts.append(("time of the whole run", _duration(time.monotonic() - self._began)))
        content = {"headline": headline, "facts": {**dict(facts), **dict(self.particulars)}, "notes": notes,
                   "details": self.details, "views": self._views}
        write_json(self.folder / "report.json", self.title.removeprefix("pagas-cl "), content)
        header = ["seconds for this view" if key == "seconds" else key for key in columns]
        page = html_page(self.title, notes, header, rows, self._sections, LEGEND if self._views else [],
                         headline=headline, facts=facts, lead=bar(self._views), body=self._mesh,
                         details=folded("Command, settings and measurements",
                                        pairs(self.particulars) + paragraphs(self.details)),
                         scripts=["page.js", *(SCRIPTS if self._mesh else [])])
        return write_text(self.folder / "index.html", page)

    def _figures(self, stem: str, pictures) -> list[str]:
        """Write the pictures; HTML of those before and after each other's, then of the single ones."""
        links = {}
        for picture in pictures:
            links[picture.key] = f"{stem}_{picture.key}.{'jpg' if picture.key == 'photo' else 'png'}"
            write_image(self.folder / links[picture.key], picture.pixels)
        found = {picture.key: picture for picture in pictures}
        pairs = [(key, key.replace("_before", "_after")) for key in found if key.endswith("_before")]
        single = [picture for key, picture in found.items() if not any(key in pair for pair in pairs)]
        return ([compared(found[a], found[b], (links[a], links[b])) for a, b in pairs]
                + [figure(picture, links[picture.key], len(single) == 1) for picture in single])


def _change_figures(change, confidence, after) -> dict:
    figures = {}
    if np.isfinite(change).any():
        moved = np.abs(change[np.isfinite(change)])
        figures["median change (px)"] = round(float(np.median(moved)), 4)
        figures["95% change (px)"] = round(float(np.percentile(moved, 95)), 4)
    if (after > 0).any():
        figures["mean confidence"] = round(float(confidence[after > 0].mean()), 4)
    return figures


def _cells(row: dict, columns) -> list[str]:
    """The row of the table: pixels as shares, other figures as they are."""
    share = shares(row)
    pixels = sum(row.get(name, 0) for name in (*STATUS, "no surface"))
    if pixels and "no surface" in row:
        share["no surface"] = row["no surface"] / pixels
    return [f"{share[key]:.1%}" if key in share else _cell(row.get(key)) for key in columns]


def _cell(value) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.4g}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60)
    return f"{seconds:.1f} s" if seconds < 100 else f"{minutes} min" if minutes < 100 else f"{minutes / 60:.1f} h"


def shares(row: dict) -> dict[str, float]:
    """Shares of the pixels with a surface, 0 to 1, of a view's counts; empty without any."""
    total = sum(row.get(name, 0) for name in STATUS)
    return {name: row[name] / total for name in STATUS if name in row} if total else {}


def summed(rows: list[dict]) -> dict[str, int]:
    return {name: sum(row.get(name, 0) for row in rows) for name in (*STATUS, "no surface")
            if any(name in row for row in rows)}


def sentence(rows: list[dict], reasons: list[str], stopped: str = "") -> str:
    """What became of the views `rows` (unchanged: with a reason, not ""); where most are so, what to do."""
    done = f"{len(rows)} view{'s' * (len(rows) != 1)}"
    if stopped:
        done += f" (the run ended with: {stopped})"
    returned = [reason for reason in reasons if reason]
    share = shares(summed(rows))
    if not rows:
        return f"Nothing was refined: the run ended before a view was done, with: {stopped}." if stopped else ""
    if not share:
        return f"Nothing was refined: {done}, none with a surface to start from."
    if not share.get("refined"):
        return f"Nothing was refined: {done}, all unchanged" + (f" ({_why(returned)})." if returned else ".")
    moves = [(row["median change (px)"], row["95% change (px)"]) for row in rows
             if row.get("refined") and "median change (px)" in row]
    text = f"The photos refined {share['refined']:.1%} of the surface in {done}."
    if moves:
        half, most = np.median(moves, axis=0)
        text += f" Half of it moved by more than {half:.2g} pixels as other photos see it, 5% by more than {most:.2g}."
    if returned:
        text += (f" {len(returned)} of the views {'stays' if len(returned) == 1 else 'stay'} unchanged "
                 f"({_why(returned)}).")
    if share["refined"] < 0.5:
        text += (" Most of the surface stays unchanged: unless masks leave it out, check cameras and photos with "
                 "'pagas-cl check', or add photos of it from places nearby.")
    return text


def _why(returned: list[str]) -> str:
    """The commonest of the reasons, and for how many where others have another one."""
    reason, times = commonest(returned)
    return reason if times == len(returned) else f"{times} of them: {reason}"


def proof(reports: Sequence[dict[str, Any]], reasons: Sequence[str], hold_out: str = "") -> str:
    """Whether photos that took no part in refining a view agree better through its refined depth, and on how many
    views, from the `reports` of DepthResults; a view with a reason (not "") stays as it was. `hold_out`: names of
    photos that were kept out of everything, as a shell takes them."""
    pairs = [(before, before if reason else after) for report, reason in zip(reports, reasons)
             for before, after in _judged(report.get("held_out_costs", ()))]
    if not pairs:
        how = (f": compare by what was held out, with 'pagas-cl evaluate --held-out {hold_out}'." if hold_out
               else ", since every photo took part: keep some out with --hold-out, and compare with 'pagas-cl evaluate "
                    "--held-out'.")
        return _NOT_MEASURED + how if "" in reasons and any(reports) else ""
    text = agreement(pairs)
    small = [report["smaller_sizes"] for report in reports if "smaller_sizes" in report]
    at_first = [pair for size in small for pair in _judged(size["held_out_costs"])]
    if at_first:
        before, after = np.median(at_first, axis=0)
        text += f" Smaller sizes came before that: {before:.3g} to {after:.3g} at {small[0]['scale']:g} of the size."
    return text


def _judged(costs: Iterable[Sequence[float | None]]) -> list[tuple[float, float]]:
    """Mean before and after over the photos that see a view; nothing where none does."""
    seen = np.array([pair for pair in costs if None not in pair], np.float64).reshape(-1, 2)
    seen = seen[np.isfinite(seen).all(axis=1)]
    return [tuple(seen.mean(axis=0).tolist())] if len(seen) else []


def agreement(pairs: Sequence[tuple[float, float]], of: str = "view") -> str:
    """The sentence of (before, after), 1 - correlation of photos that took no part, one pair for each `of`."""
    before, after = np.median(pairs, axis=0)
    better, worse = (sum(sign * (a - b) > 0 for b, a in pairs) for sign in (-1, 1))
    verdict = ("Photos that took no part agree better" if (after, worse) < (before, better) else
               "Nothing was gained: photos that took no part agree no better" if (after, worse) == (before, better) else
               "Photos that took no part agree worse")
    return (f"{verdict}: {before:.3g} before, {after:.3g} after (1 - correlation, median of {len(pairs)} "
            f"{of}{'s' * (len(pairs) != 1)}; better on {better}, worse on {worse}).")


def bar(rows: list[dict]) -> str:
    share = shares(summed(rows))
    if not share:
        return ""
    parts = "".join(f'<i class="{name}" style="flex:{part:.4f}"></i>' for name, part in share.items() if part)
    keys = "".join(f'<span><i class="{name}"></i>{escape(name)} {part:.1%}</span>' for name, part in share.items())
    return f'<div class="shares">{parts}</div><div class="keys">{keys}</div>'
