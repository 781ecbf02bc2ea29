"""Names out of files: absurdly long ones, ones that lead out, links, and what photos hold that is not used."""

import json
import logging
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image
from support import exports
from support.example_scenes import frames_of
from support.exports_depth import EXPORTS
from support.frames import photos
from support.scenes import relief_scene

from pagas_cl.errors import InputError, short
from pagas_cl.scene.images import has_alpha
from pagas_cl.scene.readers import read_scene
from pagas_cl.scene.view import Scene

TEXTS = {".txt", ".json", ".out", ".mlp", ".log", ""}
LONG = {"one part": "x" * 5000, "many parts": "a/" * 2500 + "x", "spaces": "a b " * 1250, "controls": "\x1b]0;" * 1250}
PLAIN = ["neus", "mvsnet", "da3", "da3-npy", "vggt", "mapanything", "record3d", "polycam", "scannet", "7scenes",
         "dvmvs", "record3d-exr", "open3d"]      # name no photos, or find them by listing a folder


@pytest.fixture(scope="module")
def frames():
    return frames_of(relief_scene(64, 48, 2, held_out=0))


def name_writers():
    return {**{name: write for name, write in EXPORTS.items() if name not in PLAIN},
            "colmap-txt": lambda folder, frames: exports.colmap_txt(folder / "sparse", photos(folder, frames))}


def renamed(folder, old, new):
    """Every text file of the scene with the photo's name `old` replaced; how many files had it."""
    count = 0
    for path in folder.rglob("*"):
        if path.is_file() and path.suffix in TEXTS | {".bin"} and old.encode() in path.read_bytes():
            value = json.dumps(new)[1:-1] if path.suffix == ".json" else new
            path.write_bytes(path.read_bytes().replace(old.encode(), value.encode()))
            count += 1
    return count


def first_photo(folder):
    return min(path.name for path in folder.rglob("*0000*.png"))


@pytest.mark.parametrize("how", LONG)
@pytest.mark.parametrize("name", sorted(name_writers()))
def test_a_name_of_thousands_of_characters(frames, tmp_path, name, how):
    """Every reader that takes names of photos from a file: refused in a sentence that a terminal holds."""
    name_writers()[name](tmp_path, frames)
    old, new = first_photo(tmp_path), LONG[how] + ".png"
    if not renamed(tmp_path, old, new):
        pytest.skip("the format's files name no photos")
    with pytest.raises(InputError) as error:
        read_scene(tmp_path, **({"flavour": "meshlab", "format": "meshlab"} if name == "meshlab" else {}))
    assert len(str(error.value)) < 800, name


def test_the_command_line_ends_with_status_2(frames, tmp_path):
    EXPORTS["bundler"](tmp_path, frames)
    if not renamed(tmp_path, first_photo(tmp_path), "x" * 5000 + ".png"):
        (tmp_path / "list.txt").write_text("".join(f"{'x' * 5000}{k}.png\n" for k in range(len(frames))))
    ended = subprocess.run([sys.executable, "-m", "pagas_cl", "check", str(tmp_path)], capture_output=True, text=True,
                           timeout=100)
    assert ended.returncode == 2 and len(ended.stderr.splitlines()[-1]) < 500 and "Traceback" not in ended.stderr


def test_what_is_shortened_keeps_both_ends():
    assert short("abc") == "'abc'" and len(short("x" * 5000)) <= 60
    assert short("/long/" * 50 + "name.png").endswith("name.png'")


def test_a_bundler_list_of_long_names(frames, tmp_path):
    EXPORTS["bundler"](tmp_path, frames)
    for name in LONG.values():
        (tmp_path / "list.txt").write_text("".join(f"{name.replace(' ', '_')}{k}.png\n" for k in range(len(frames))))
        with pytest.raises(InputError) as error:
            read_scene(tmp_path, "bundler")
        assert len(str(error.value)) < 800


@pytest.mark.parametrize("name", ["../../x.png", "/x.png", "a/../../x.png"])
def test_names_that_cannot_name_files_are_refused_where_the_scene_is_read(frames, tmp_path, name):
    """With --outside the photo may be there; its name cannot be that of a result. Nothing is made before."""
    folder = tmp_path / "deep" / "scene"
    folder.mkdir(parents=True)
    views = photos(folder, frames)
    exports.colmap_txt(folder / "sparse", views)
    outside = (folder / "images" / name).resolve() if not name.startswith("/") else tmp_path / "x.png"
    outside.write_bytes((folder / "images" / views[0].name).read_bytes())
    given = name if not name.startswith("/") else str(outside)
    renamed(folder / "sparse", views[0].name, given)
    with pytest.raises(InputError, match="leads out of"):
        read_scene(folder)
    with pytest.raises(InputError, match="COLMAP model .* cannot name files in the output folder.*call the photo so"):
        read_scene(folder, outside=True)
    ended = subprocess.run([sys.executable, "-m", "pagas_cl", "refine", str(folder), "--outside", "--mesh",
                            str(tmp_path / "none.ply"), "--output", str(tmp_path / "out" / "fine.ply")],
                           capture_output=True, text=True, timeout=100)
    assert ended.returncode == 2 and not (tmp_path / "out").exists()


def test_a_scene_of_two_views_of_one_name_is_refused(frames, tmp_path):
    views = photos(tmp_path, frames)
    with pytest.raises(InputError, match="made: 2 views are called '000000.png'"):
        Scene([views[0], views[0]], "made")


@pytest.mark.parametrize("what", ["images", "masks", "depth"])
def test_files_behind_links_are_logged(frames, tmp_path, caplog, what):
    folder = tmp_path / "scene"
    EXPORTS["open3d" if what == "depth" else "nerfstudio"](folder, frames)
    if what == "masks":
        (folder / "masks").mkdir()
        for path in (folder / "images").iterdir():
            Image.fromarray(np.full((48, 64), 255, np.uint8)).save(folder / "masks" / path.name)
    (folder / what).rename(tmp_path / "outside")
    (folder / what).symlink_to(tmp_path / "outside")
    with caplog.at_level(logging.WARNING, "pagas_cl"):
        read_scene(folder)
    assert f"{len(frames)} photos, masks or depth maps" in caplog.text and "symbolic links" in caplog.text
    assert str(tmp_path / "outside") in caplog.text


@pytest.mark.parametrize("value", [1, 3, 6])
def test_an_orientation_that_sizes_do_not_show_is_logged_once(frames, tmp_path, caplog, value):
    EXPORTS["nerfstudio"](tmp_path, frames)
    for path in sorted((tmp_path / "images").iterdir())[1:]:
        image = Image.open(path).convert("RGB")
        image.getexif()[0x0112] = value
        image.save(path, exif=image.getexif())
    with caplog.at_level(logging.WARNING, "pagas_cl"):
        for view in read_scene(tmp_path).views:
            view.load_image()
    lines = [line for line in caplog.messages if "EXIF orientation" in line]
    assert len(lines) == (value == 3)
    assert value != 3 or f"{len(frames) - 1} of {len(frames)} photos" in lines[0]


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "LA", "P"])
def test_an_alpha_channel_that_is_not_used_is_logged_once(frames, tmp_path, caplog, mode):
    EXPORTS["nerfstudio"](tmp_path, frames)
    for path in sorted((tmp_path / "images").iterdir())[1:]:
        image = Image.open(path).convert(mode)
        image.save(path, **({"transparency": 0} if mode == "P" else {}))
    with caplog.at_level(logging.WARNING, "pagas_cl"):
        scene = read_scene(tmp_path)
        for view in scene.views:
            view.load_image()
    lines = [line for line in caplog.messages if "alpha channel, which is not used" in line]
    assert len(lines) == (mode != "RGB")
    assert mode == "RGB" or f"{len(frames) - 1} of {len(frames)} photos" in lines[0]


def test_the_a_of_lab_is_no_alpha_channel(tmp_path):
    Image.new("LAB", (4, 3)).save(tmp_path / "a.tif")
    assert not has_alpha(tmp_path / "a.tif")
