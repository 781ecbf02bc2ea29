"""The pages in a real browser, at the width of a desk and of a phone."""

import numpy as np
import pytest
from support import chromium
from test_mesh_view import grid

from pagas_cl import Camera, View
from pagas_cl.report import Report
from pagas_cl.report.page import html_page

pytestmark = [pytest.mark.slow, pytest.mark.skipif(
    chromium.found() is None, reason="no Chromium here: looked for " + ", ".join(chromium.NAMES))]

WIDTHS = [(1280, False), (390, True)]
BAR = "parseFloat(getComputedStyle(document.querySelector('{}')).getPropertyValue('--at'))"
SLIDE = "(slider => { slider.value = %d; slider.dispatchEvent(new Event('input')); })"
DRAWN = """(() => {
  const box = document.querySelector(".viewer"), canvas = box.querySelector("canvas");
  box.draw();
  const gl = canvas.getContext("webgl2"), pixels = new Uint8Array(4 * canvas.width * canvas.height);
  gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  let drawn = 0, colored = 0, sum = 0;
  for (let i = 0; i < pixels.length; i += 4) {
    const [r, g, b] = pixels.subarray(i, i + 3);
    if (Math.abs(r - 32) + Math.abs(g - 37) + Math.abs(b - 47) > 12) { drawn++; sum += r * (i % 9973); }
    if (Math.abs(r - b) > 60) colored++;
  }
  return [drawn / (pixels.length / 4), colored / (pixels.length / 4), sum];
})()"""


@pytest.fixture(scope="module")
def tab(tmp_path_factory):
    with chromium.browser(tmp_path_factory.mktemp("profile")) as page:
        yield page


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    folder, long = tmp_path_factory.mktemp("report"), "a_name_without_any_place_to_break_it_" * 4
    camera = Camera(320, 240, 300, 300, 160, 120, np.eye(4))
    depth = np.full((240, 320), 4, np.float32)
    with Report(folder, facts=[("command", f"pagas-cl refine {long}/{long}"), ("device", long)]) as page:
        for name in (f"<img src=x onerror=alert(1)>{long}.png", "b'\"&.png"):
            page.add(View(camera, np.full((240, 320, 3), 99, np.uint8), name=name), depth, depth + 0.1,
                     parallax=depth / 9, confidence=depth / 8, remarks=[long],
                     counts={"refined": 10, "kept": 1, "rejected": 1, "no surface": 1, "seconds": 1.5})
        page.add_mesh(grid(lambda x, y: 0 * x), grid(lambda x, y: 0.2 * np.sin(4 * x) * np.sin(4 * y)),
                      view=View(camera, np.zeros((240, 320, 3), np.uint8), name=long), depths=(depth, depth))
    return folder / "index.html"


def open_page(tab, path, width, phone):
    tab.open(path, width, 844, phone)
    assert tab.value("document.documentElement.scrollWidth <= innerWidth"), "something overflows"
    assert tab.value("innerWidth") == width


@pytest.mark.parametrize("width, phone", WIDTHS)
def test_the_report_fits_its_sliders_move_and_its_pictures_sharpen(tab, report, width, phone):
    open_page(tab, report, width, phone)
    assert tab.value("document.querySelectorAll('[onerror]').length") == 0, "a name became HTML"
    tab.value("document.querySelectorAll('.pair')[1].scrollIntoView({block: 'center'})")
    left, top, wide, high = tab.value("(r => [r.left, r.top, r.width, r.height])"
                                      "(document.querySelectorAll('.pair')[1].getBoundingClientRect())")
    assert wide > 0.4 * width
    tab.drag((left + wide / 2, top + high / 2), (left + wide / 5, top + high / 2))
    at = BAR.replace("document.querySelector('{}')", "document.querySelectorAll('.pair')[1]")
    assert tab.value(at) == pytest.approx(20, abs=1)
    tab.value(SLIDE % 80 + "(document.querySelectorAll('.pair input')[1])")
    assert tab.value(at) == 80
    tab.wait("document.querySelectorAll('.pair')[1].querySelector('img').src.startsWith('file:')")


@pytest.mark.parametrize("width, phone", WIDTHS)
def test_the_mesh_is_drawn_turned_coloured_and_compared(tab, report, width, phone):
    open_page(tab, report, width, phone)
    tab.wait("document.querySelector('.viewer').draw !== undefined")
    drawn, colored, first = tab.value(DRAWN)
    assert drawn > 0.1 and colored < 0.01 and tab.value("document.querySelector('.told') === null")
    tab.value("document.querySelectorAll('.viewer button')[1].click()")
    assert tab.value(DRAWN)[1] > 0.02, "the half after is coloured"
    tab.value(SLIDE % 100 + "(document.querySelector('.stage input'))")
    assert tab.value(DRAWN)[1] < 0.01 and tab.value(BAR.format(".stage")) == 100, "all of it is the mesh before"
    flat = tab.value(DRAWN)[2]
    tab.value("document.querySelector('canvas').scrollIntoView({block: 'center'})")
    x, y, wide = tab.value("(r => [r.left + r.width / 2, r.top + r.height / 2, r.width])"
                           "(document.querySelector('canvas').getBoundingClientRect())")
    tab.drag((x, y), (x + wide / 5, y + 30))
    assert tab.value(DRAWN)[2] != flat
    tab.value("document.querySelector('canvas').dispatchEvent(new MouseEvent('dblclick'))")
    assert tab.value(DRAWN)[2] == flat, "as at first"


@pytest.mark.parametrize("width, phone", WIDTHS)
def test_a_wide_table_and_a_picture_stay_inside(tab, tmp_path, width, phone):
    header = [f"a heading {k}" for k in range(30)]
    path = tmp_path / "index.html"
    path.write_text(html_page("t", [], header, [header], picture="no such.png", headline="w" * 300))
    open_page(tab, path, width, phone)
