"""The report: colours, the change in pixels of parallax, and the files of a run."""

import json
import re
import time
from html import escape

import numpy as np
import pytest
from PIL import Image

from pagas_cl import Camera, View
from pagas_cl.app.report import Report, picture_files
from pagas_cl.app.report.pictures import (
    NOTHING,
    change_in_units,
    colored,
    depth_range,
    normal_colors,
    shaded,
    view_pictures,
)
from pagas_cl.app.report.writer import proof, sentence
from pagas_cl.method.effects.decide import Decision
from pagas_cl.result import DepthResult
from pagas_cl.scene.depthmap import KEPT, REFINED
from pagas_cl.scene.names import flat_stem

WIDTH, HEIGHT = 40, 30


def camera(x=0.0, name="a.png"):
    pose = np.eye(4)
    pose[0, 3] = -x
    return Camera(WIDTH, HEIGHT, 50, 50, 20, 15, pose, name)


def plane(z):
    return np.full((HEIGHT, WIDTH), z, np.float32)


def refined(kept=0, reason="", report=()):
    """A result 0.1 farther than 4, to half a confidence, but for the first `kept` pixels."""
    status = np.full(HEIGHT * WIDTH, REFINED, np.uint8)
    status[:kept] = KEPT
    return DepthResult(camera(), plane(4.1), status.reshape(HEIGHT, WIDTH), plane(0.5), plane(0.5), reason,
                       dict(report))


def test_colored_spans_the_map_and_marks_what_has_no_value():
    rgb = colored(np.array([[0.0, 1.0, 9.0, np.nan]]), 0, 1, np.array([[True, True, True, False]]))
    assert rgb.dtype == np.uint8 and tuple(rgb[0, 3]) == NOTHING
    assert (rgb[0, 1] == rgb[0, 2]).all() and rgb[0, 1].sum() > rgb[0, 0].sum()
    assert (colored(np.zeros((1, 1)), -1, 1, np.ones((1, 1), bool), "signed") == 255).all()


def test_normal_colors_do_not_depend_on_the_sign():
    n = np.array([[[0.6, 0.0, -0.8]]])
    valid = np.ones((1, 1), bool)
    assert (normal_colors(n, valid) == normal_colors(-n, valid)).all()
    assert tuple(normal_colors(np.array([[[0.0, 0.0, -1.0]]]), valid)[0, 0]) == (128, 128, 255)


def test_the_change_is_in_pixels_of_parallax_and_unknown_without_depth_or_without_a_view():
    before, after, parallax = plane(4.0), plane(4.5), plane(0.25)
    before[0], after[1], parallax[2] = 0, 0, 0
    change = change_in_units(before, after, parallax)
    assert np.isnan(change[:3]).all() and (change[3:] == 2).all()
    assert (change_in_units(plane(4.0), plane(3.9), plane(0.1)) < 0).all(), "nearer"


def test_a_refined_camera_has_a_picture_of_what_it_moved():
    """By 50 * 0.2 / 4 pixels to the side, as the scale says; none where the camera is as it was given."""
    def last(depth):
        return view_pictures(np.zeros((HEIGHT, WIDTH, 3)), camera(), plane(4.0), depth, change=plane(0),
                             confidence=plane(0), given=camera(0.2))[-1]

    made = last(plane(4.0))
    assert made.key == "camera" and "from 0 to 2.5" in made.legend and (made.pixels == made.pixels[0, 0]).all()
    assert (last(plane(0.0)).pixels == NOTHING).all()


def test_depth_range_of_nothing():
    assert depth_range(plane(0)) == (0, 1)


def test_pictures_have_the_size_of_the_view_even_where_nothing_is_valid():
    photo = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    pictures = view_pictures(photo, camera(), plane(0), plane(0), change=np.full((HEIGHT, WIDTH), np.nan),
                             confidence=plane(0))
    assert [p.key for p in pictures] == ["photo", "depth_before", "depth_after", "normals_before", "normals_after",
                                         "change", "confidence"]
    assert all(p.pixels.shape == photo.shape and p.pixels.dtype == np.uint8 for p in pictures)


@pytest.mark.parametrize("name, stem", [("a.jpg", "a"), ("cam1/a b.jpg", "cam1_a_b"), ("../..", "view"), ("", "view")])
def test_file_stem(name, stem):
    assert flat_stem(name) == stem


def test_report_writes_pictures_page_and_numbers(tmp_path):
    view = View(camera(name="<b>.png"), np.full((HEIGHT, WIDTH, 3), 99, np.uint8))
    folder = tmp_path / "made" / "here"
    with pytest.raises(KeyboardInterrupt):
        with Report(folder, "a <title>", ["one note"]) as report:
            report.add(view, plane(4.0), refined())
            raise KeyboardInterrupt  # the page of what was done is written all the same
    page = (folder / "index.html").read_text()
    assert "a &lt;title&gt;" in page and "&lt;b&gt;.png" in page and "<b>.png" not in page
    assert page.count("data:image/jpeg") == 7 and "http" not in page
    assert "rejected = unchanged, since" in page and "dark grey = no value" in page
    data = json.loads((folder / "report.json").read_text())["views"][0]
    assert data["refined"] == 1200 and '<td data-name="refined">100.0%</td>' in page and data["mean confidence"] == 0.5
    names = sorted(path.name for path in folder.iterdir())
    assert len(names) == 9 and not any("part" in name for name in names)
    assert Image.open(folder / "b_depth_after.png").size == (WIDTH, HEIGHT)


def test_every_picture_has_a_name_that_is_checked_first(tmp_path):
    """Else one of somebody else would be replaced (picture_files)."""
    view = View(camera(name="a.png"), np.full((HEIGHT, WIDTH, 3), 99, np.uint8))
    with Report(tmp_path, "a title", []) as report:
        report.add(view, plane(4.0), refined(), given=camera(0.2))
    assert {path.name for path in tmp_path.glob("*.*g")} == set(picture_files([view.name]))


def test_report_without_views_has_a_page(tmp_path):
    assert "nothing" in Report(tmp_path, "nothing").write().read_text()


def counts(refined, kept=0, rejected=0, nothing=0):
    return {"refined": refined, "kept": kept, "rejected": rejected, "no surface": nothing}


@pytest.mark.parametrize("rows, reasons, stopped, said", [
    ([counts(90, 6, 4), counts(80, 20)], ["", ""], "", "The photos refined 85.0% of the surface in 2 views."),
    ([counts(90, 10), counts(0, 100)], ["", "blurred"], "", "1 of the views stays unchanged (blurred)."),
    ([counts(0, 100), counts(0, 100)], ["too far", "too far"], "", "Nothing was refined: 2 views, all unchanged"),
    ([counts(9), counts(0, 1), counts(0, 1)], ["", "off by 0.5 (a.png)", "off by 1.2 (b.png)"], "",
     "2 of the views stay unchanged (for instance, off by 0.5 (a.png))."),
    ([counts(9), counts(0, 1), counts(0, 1), counts(0, 1)], ["", "blurred", "off by 1.2", "off by 0.5"], "",
     "3 of the views stay unchanged (2 of them: for instance, off by 1.2)."),
    ([counts(40, 60)], [""], "", "stays unchanged: unless masks leave it out, check cameras"),
    ([counts(0, 0, 0, 50)], [""], "", "none with a surface"),
    ([counts(10)], [""], "disk full", "in 1 view (the run ended with: disk full)"),
    ([], [], "interrupted", "before a view was done, with: interrupted")])
def test_the_headline_says_what_became_of_the_views(rows, reasons, stopped, said):
    assert said in sentence(rows, reasons, stopped)


def judged(*costs, **more):
    return {"held_out_costs": costs, **more}


AT_FIRST = {"smaller_sizes": {"scale": 0.25, "held_out_costs": [(0.4, 0.2)]}}


@pytest.mark.parametrize("reports, reasons, said", [
    ([judged((0.3, 0.1), (0.1, 0.1)), judged((0.4, 0.2))], ["", ""],
     "agree better: 0.3 before, 0.15 after (1 - correlation, median of 2 views; better on 2, worse on 0)."),
    ([judged((0.3, 0.1)), judged((0.2, 0.9))], ["", "it would be worse"], "of 2 views; better on 1, worse on 0)."),
    ([judged((0.2, 0.9))], ["it would be worse"], "Nothing was gained: photos that took no part agree no better: 0.2 "),
    ([judged((0.3, 0.1)), *[judged((0.2, 0.2))] * 3, judged((0.2, 0.1))], [""] * 5, "agree better: 0.2 before, 0.2 "),
    ([judged((0.1, 0.2)), *[judged((0.2, 0.2))] * 2, judged((0.3, 0.2))], [""] * 4,
     "Nothing was gained: photos that took no part agree no better: 0.2 before, 0.2 after (1 - correlation, median of "
     "4 views; better on 1, worse on 1)."),
    ([judged((0.2, 0.3))], [""], "agree worse: 0.2 before, 0.3 after (1 - correlation, median of 1 view; better"),
    ([judged((None, None), (float("nan"), 0.1))], [""], "was not measured, since every photo took part"),
    ([judged()], [""], "keep some out with --hold-out"),
    ([judged((0.2, 0.1), **AT_FIRST)], [""], "Smaller sizes came before that: 0.4 to 0.2 at 0.25 of the size."),
    ([], [], ""), ([{}], [""], ""), ([judged()], ["there is no other view"], "")])
def test_the_proof_says_how_photos_that_took_no_part_agree(reports, reasons, said):
    assert said in proof(reports, reasons) and (said or not proof(reports, reasons))


def test_the_page_has_shares_facts_and_pictures_in_pairs(tmp_path):
    view = View(camera(name="a.png"), np.full((HEIGHT, WIDTH, 3), 99, np.uint8))
    shares = ["all 2 views", "37.5%", "62.5%", "0.0%", "0.0%", "", "", ""]
    with Report(tmp_path, facts=[("scene", "here")], began=time.monotonic(), particulars=[
            ("command", "pagas-cl 'a <b>'"), ("version", "pagas_cl 1")]) as report:
        for reason in ("", "<i>dark</i>"):
            report.add(view, plane(4.0), refined(kept=1200 if reason else 300, reason=reason))
    page = (tmp_path / "index.html").read_text()
    assert "37.5% of the surface in 2 views" in page and "&lt;i&gt;dark&lt;/i&gt;" in page and "<i>dark" not in page
    assert re.findall(r">([^<>]*)</td>", page)[-len(shares):] == shares
    assert "<code>pagas-cl &#x27;a &lt;b&gt;&#x27;</code>" in page and "<dt>time of the whole run</dt>" in page
    assert page.count('<div class="pair">') == 4, "depth and normals of two views"
    data = json.loads((tmp_path / "report.json").read_text())
    assert data["facts"]["version"] == "pagas_cl 1" and escape(data["headline"]) in page


def test_what_was_measured_is_folded_and_what_became_of_the_run_is_not(tmp_path):
    view = View(camera(name="a.png"), np.full((HEIGHT, WIDTH, 3), 99, np.uint8))
    with Report(tmp_path, facts=[("scene", "here")], particulars=[("device", "a long name")]) as report:
        report.notes.append("cameras were corrected")
        report.details.append("consistency off: 0.0006, threshold 0.04")
        report.add(view, plane(4.0), refined(report={
            "contexts": ["b.png"], "seconds": 1.5,
            "effects": [Decision("exposure", 0.0005, 0.012, False, "brightness of photos").as_dict()]}))
    page = (tmp_path / "index.html").read_text()
    folded = re.findall("<details>.*?</details>", page, re.S)
    open_ = re.sub("<details>.*?</details>", "", page, flags=re.S)
    assert "threshold" not in open_ and "a long name" not in open_
    assert "cameras were corrected" in open_ and "compared with the photos" in open_ and "moved by more than" in open_
    assert "consistency off" in folded[0] and "a long name" in folded[0] and "exposure off" in folded[1]
    assert "time of the whole run" not in page and "seconds for this view" in page, "what a time is of stands with it"
    assert json.loads((tmp_path / "report.json").read_text())["details"] == ["consistency off: 0.0006, threshold 0.04"]


def test_a_mesh_without_one_before_says_why(tmp_path):
    mesh = (np.eye(3), [[0, 1, 2]])
    for before, data in ((None, True), (mesh, False)):
        with Report(tmp_path) as report:
            report.add_mesh(before, mesh)
        assert ("There is no mesh before: the run" in (tmp_path / "index.html").read_text()) == data


def test_shaded_pictures_are_brighter_where_the_surface_faces_the_light():
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - 20, np.arange(HEIGHT) + 0.5 - 15)
    lit, away = (shaded(4 / (1 + side * (x + y) / 50), camera())[10, 20].sum() for side in (0.5, -0.5))
    assert lit > away + 100 and tuple(shaded(plane(0), camera())[5, 5]) == NOTHING


def test_views_of_like_names_have_pictures_of_their_own(tmp_path):
    names = ["cam/a.png", "cam_a.png", "cam_a.jpg", "CAM/A.png", "mesh.png", "å" * 120 + ".png", "cam_a_2.png"]
    with Report(tmp_path) as report:
        for k, name in enumerate(names):
            report.add(View(camera(name=name), np.full((HEIGHT, WIDTH, 3), 20 * k, np.uint8)), plane(4.0), refined())
        report.add_mesh((np.eye(3), [[0, 1, 2]]), (np.eye(3), [[0, 1, 2]]), depths=(plane(4), plane(4)),
                        view=View(camera(), np.full((HEIGHT, WIDTH, 3), 255, np.uint8)))
    photos = sorted(tmp_path.glob("*_photo.jpg"))
    shown = {round(float(np.asarray(Image.open(path)).mean()) / 20) for path in photos}
    assert len(photos) == 8 and shown == {*range(7), 13}
