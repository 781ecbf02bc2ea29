"""The pages in a real browser, at the width of a desk and of a phone."""

import numpy as np
import pytest
from support import chromium
from test_mesh_view import grid

from pagas_cl import Camera, View
from pagas_cl.app.report import Report, write_mesh_page
from pagas_cl.app.report.page import html_page
from pagas_cl.result import DepthResult
from pagas_cl.scene.depthmap import REFINED

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
    with Report(folder, facts=[("scene", long)],
                particulars=[("command", f"pagas-cl refine {long}/{long}"), ("device", long)]) as page:
        for name in (f"<img src=x onerror=alert(1)>{long}.png", "b'\"&.png"):
            page.add(View(camera, np.full((240, 320, 3), 99, np.uint8), name=name), depth, DepthResult(
                camera, depth + 0.1, np.full(depth.shape, REFINED, np.uint8), depth / 9, depth / 9,
                report={"contexts": [long], "seconds": 1.5}))
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
    assert drawn > 0.1 and colored < 0.01 and tab.value("document.querySelector('.loading') === null")
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


EDGE = """(() => {
  const box = document.querySelector(".viewer"), canvas = box.querySelector("canvas"), gl = canvas.getContext("webgl2");
  box.draw();
  const { width, height } = canvas, pixels = new Uint8Array(4 * width * height);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  let left = width, right = 0, low = height, high = 0;
  for (let y = 0; y < height; y++) for (let x = 0; x < width; x++) {
    const [r, g, b] = pixels.subarray(4 * (y * width + x));
    if (Math.abs(r - 32) + Math.abs(g - 37) + Math.abs(b - 47) <= 12) continue;
    left = Math.min(left, x); right = Math.max(right, x); low = Math.min(low, y); high = Math.max(high, y);
  }
  return [left / width, right / width, low / height, high / height];
})()"""


@pytest.mark.parametrize("width, phone", WIDTHS)
@pytest.mark.parametrize("shape", ["towards the eye", "thin ends", "tall"])
def test_all_of_the_mesh_is_seen_at_first_and_fills_the_canvas(tab, tmp_path, width, phone, shape):
    vertices, faces = grid(lambda x, y: 0 * x)
    vertices = vertices - (1.5, 1.5, 0)
    if shape == "towards the eye":       # the near end is many times as large as the far one
        vertices[:, 2] = 1.2 * vertices[:, 1]
    elif shape == "thin ends":           # less than a hundredth of the vertices, a quarter of the width
        vertices[:, 0] *= np.where(np.abs(vertices[:, 0]) > 1.499, 1.4, 1)
        vertices[:, 1] *= 0.6
        vertices = np.concatenate([vertices, vertices[np.abs(vertices[:, 0]) < 2] * (0.3, 1, 1)])
    else:
        vertices[:, 0] *= 0.2
    camera = Camera(320, 240, 300, 300, 160, 120, np.diag([1.0, -1, -1, 1]))
    open_page(tab, write_mesh_page(tmp_path / "mesh.html", None, (vertices, faces), camera=camera), width, phone)
    tab.wait("document.querySelector('.viewer').draw !== undefined")
    left, right, low, high = tab.value(EDGE)
    assert min(left, low) > 0.01 and max(right, high) < 0.99, "cut at the edge"
    assert max(right - left, high - low) > 0.7, "small in the middle"
    tab.call("Emulation.setDeviceMetricsOverride", width=844, height=390, deviceScaleFactor=1, mobile=phone)
    tab.wait("document.querySelector('canvas').clientWidth > 700")
    left, right, low, high = tab.value("new Promise(requestAnimationFrame).then(() => new Promise("
                                       f"requestAnimationFrame)).then(() => {EDGE})")
    assert min(left, low) > 0.01 and max(right, high) < 0.99, "cut once the phone is turned"


@pytest.mark.parametrize("width, phone", WIDTHS)
def test_no_column_of_the_report_is_hidden(tab, report, width, phone):
    open_page(tab, report, width, phone)
    cut = tab.value("[...document.querySelectorAll('td')].filter(cell => cell.getClientRects().length && "
                    "cell.getBoundingClientRect().right > innerWidth).length")
    shown = tab.value("[...document.querySelectorAll('td')].filter(cell => cell.getClientRects().length).length")
    assert cut == 0 and shown > 20
    named = tab.value("getComputedStyle(document.querySelectorAll('td')[1], '::before').content")
    assert ("refined" in named) == phone, "on a phone each figure stands below what it is"


@pytest.mark.parametrize("width, phone", WIDTHS)
def test_a_wide_table_and_a_picture_stay_inside(tab, tmp_path, width, phone):
    header = [f"a heading {k}" for k in range(30)]
    path = tmp_path / "index.html"
    path.write_text(html_page("t", [], header, [header], picture="no such.png", headline="w" * 300))
    open_page(tab, path, width, phone)
