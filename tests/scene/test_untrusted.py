"""Foreign files: no build options, no entities, no files outside, no memory that a header merely claims.

Besides this: paths out of the folder in test_meshlab_project.py, test_readers_colmap.py and test_jobs.py; scripts in
test_filter_script.py; damaged files in test_fuzz_*.py; names of outputs in test_report.py and test_jobs.py.
"""

from __future__ import annotations

import json
import ntpath
import re
import struct
import zlib
from pathlib import PureWindowsPath
from types import SimpleNamespace

import numpy as np
import pytest
from support import rigs, scene_writers
from support.fuzzing import bounded
from support.hard_cases import SETTINGS
from support.hard_table import config_of

from pagas_cl.config import setting_names
from pagas_cl.config.presets import PRESETS, build_config
from pagas_cl.errors import InputError
from pagas_cl.filters.filter_script import check_script
from pagas_cl.scene import depthmap, npy_files, untrusted
from pagas_cl.scene.images import read_photo
from pagas_cl.scene.meshes.kinds import to_surface
from pagas_cl.scene.readers import read_scene

HOSTILE = ("1 -D__global=", "1f -I/etc", "0x10", "1e999", "nan", "inf", "__import__('os')", "${HOME}",
           '1"', "1\n-DX", "1;X")
SAFE_DEFINE = re.compile(r"[A-Z][A-Z0-9_]*(=[-+.0-9ef]+)?")


@pytest.mark.parametrize("name", setting_names())
def test_no_setting_takes_more_than_its_value(name):
    """What a script or a command line gives as a setting never reaches the compiler as text."""
    for value in HOSTILE:
        with pytest.raises(InputError):
            build_config("balanced", [f"{name}={value}"])


def test_every_define_is_a_word_or_a_number():
    from pagas_cl.method.splat.options import defines

    class Device:
        has = staticmethod(lambda extension: True)

    configs = [*PRESETS.values(), *(config_of(case, blend) for case in SETTINGS for blend in case.blends)]
    for config in configs:
        for define in defines(config, Device, 4000):
            assert SAFE_DEFINE.fullmatch(define), define


def test_paths_on_windows(monkeypatch):
    """One with a drive may lie inside, as one from the root on other systems."""
    monkeypatch.setattr(untrusted, "os", SimpleNamespace(path=ntpath, name="nt"))
    monkeypatch.setattr(untrusted, "Path", PureWindowsPath)
    for name in ("a.png", "images\\..\\a.png", "C:\\scene\\a.png", "c:/Scene/a.png", "\\scene\\a.png"):
        assert untrusted.inside("C:\\scene", name, "the photo") == PureWindowsPath("C:\\scene\\a.png")
    for name in ("..\\a.png", "C:\\a.png", "D:\\scene\\a.png", "D:a.png", "\\\\host\\scene\\a.png", "\\\\?\\C:\\a.png"):
        with pytest.raises(InputError, match="leads out of"):
            untrusted.inside("C:\\scene", name, "the photo")


def test_build_options_through_a_script(tmp_path):
    step = '<filter name="PAGaS Depth Refinement"><Param type="{}" name="{}" value="{}"/></filter>'
    for kind, name, value in (("RichFloat", "radius", "1.2 -DX=1"),
                              ("RichString", "settings", "splatting.radius=1 -DX"),
                              ("RichString", "settings", "loss.robust=1f -I/"), ("RichString", "preset", "../paper")):
        (tmp_path / "s.mlx").write_text(f"<FilterScript>{step.format(kind, name, value)}</FilterScript>")
        with pytest.raises(InputError):
            check_script(tmp_path / "s.mlx")


LAUGHS = ('<!DOCTYPE {0} [<!ENTITY a "' + "x" * 1000 + '">' + "".join(
    f'<!ENTITY {b} "{f"&{a};" * 100}">' for a, b in zip("abcdef", "bcdefg")) + "]><{0}>&g;</{0}>")
OUTER = '<!DOCTYPE {0} [<!ENTITY a SYSTEM "file:///etc/passwd">]><{0}>&a;</{0}>'
REMOTE = '<!DOCTYPE {0} SYSTEM "http://127.0.0.1:9/x.dtd"><{0}>&a;</{0}>'


@pytest.mark.parametrize("text", [LAUGHS, OUTER, REMOTE], ids=["expanding", "file", "remote"])
def test_entities_are_never_expanded(tmp_path, text):
    (tmp_path / "s.mlx").write_text(text.format("FilterScript"))
    (tmp_path / "p.mlp").write_text(text.format("MeshLabDocument"))
    with bounded(), pytest.raises(InputError):
        check_script(tmp_path / "s.mlx")
    with bounded(), pytest.raises(InputError):
        read_scene(tmp_path, "meshlab")


def test_a_depth_map_that_unpacks_to_more_than_any_has(tmp_path, monkeypatch):
    """Kilobytes of zeros, deflated: refused by what the archive says, before anything is unpacked."""
    monkeypatch.setattr(npy_files, "MOST_BYTES", 1 << 20)
    np.savez_compressed(tmp_path / "a.npz", depth=np.zeros((1000, 1000), np.float32))
    monkeypatch.setattr(np.lib.format, "read_array", lambda *_, **__: pytest.fail("unpacked"))
    with pytest.raises(InputError, match="unpacks to 0.0 GB"):
        depthmap.load_depth(tmp_path / "a.npz")


@pytest.mark.parametrize("path", ["/etc/passwd", "../secret.png", "images/../../secret.png", "C:\\secret.png",
                                  "\\\\host\\share\\secret.png"])
def test_photo_paths_of_a_scene_file_stay_inside_unless_allowed(tmp_path, path):
    folder = tmp_path / "scene"
    folder.mkdir()
    scene_writers.nerfstudio(folder, rigs.with_photos(folder, rigs.random_cameras(1)))
    data = json.loads((folder / "transforms.json").read_text())
    data["frames"][0]["file_path"] = path
    (folder / "transforms.json").write_text(json.dumps(data))
    with pytest.raises(InputError, match="leads out"):
        read_scene(folder, "nerfstudio")


@pytest.mark.parametrize("what", ["photo", "folder", "whole scene", "inside"])
def test_links_out_of_a_scene_are_logged(tmp_path, caplog, what):
    """Photos behind symbolic links are read, and the log says where from; links that stay inside are nobody's
    business, nor is the way to the scene itself."""
    folder, outside = tmp_path / "scene", tmp_path / "outside"
    folder.mkdir(), outside.mkdir()
    scene_writers.nerfstudio(folder, rigs.with_photos(folder, rigs.random_cameras(2)))
    photo = read_scene(folder, "nerfstudio").views[0].image
    if what == "photo":
        photo.rename(outside / photo.name)
        photo.symlink_to(outside / photo.name)
    elif what == "folder":
        photo.parent.rename(outside / "photos")
        photo.parent.symlink_to(outside / "photos")
    elif what == "inside":
        photo.rename(folder / "first.png")
        photo.symlink_to(folder / "first.png")
    else:
        (tmp_path / "link").symlink_to(folder)
        folder = tmp_path / "link"
    caplog.clear()
    scene = read_scene(folder, "nerfstudio")
    assert scene.views[0].load_image().size
    assert ("symbolic links" in caplog.text) == (what in ("photo", "folder"))
    if what == "folder":
        assert f"{len(scene.views)} photos" in caplog.text and str(outside) in caplog.text


def test_a_photo_that_claims_to_be_huge(tmp_path):
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", 100000, 100000, 8, 2, 0, 0, 0)
    parts = chunk(b"IHDR", head), chunk(b"IDAT", zlib.compress(b"0")), chunk(b"IEND", b"")
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))
    with bounded(), pytest.raises(InputError):
        read_photo(tmp_path / "a.png")


@pytest.mark.parametrize("body", [b"", b"\0" * 1000])
def test_a_mesh_that_claims_to_be_huge(tmp_path, body):
    head = ("ply\nformat binary_little_endian 1.0\nelement vertex 2000000000\nproperty float x\nproperty float y\n"
            "property float z\nelement face 2000000000\nproperty list uchar int vertex_indices\nend_header\n")
    (tmp_path / "a.ply").write_bytes(head.encode() + body)
    (tmp_path / "a.off").write_bytes(b"OFF\n2000000000 2000000000 0\n" + body)
    for name in ("a.ply", "a.off"):
        with bounded(), pytest.raises(InputError, match="claims"):
            to_surface(tmp_path / name)


def test_a_mesh_that_is_cut_off(tmp_path):
    from pagas_cl.scene.mesh import Surface
    from pagas_cl.scene.meshes.files import write_mesh

    corners, faces = np.random.default_rng(1).random((30, 3)), np.arange(30).reshape(10, 3)
    write_mesh(tmp_path / "whole.ply", Surface(corners, faces))
    whole = (tmp_path / "whole.ply").read_bytes()
    assert len(to_surface(tmp_path / "whole.ply").faces) == 10
    for cut in (1, 13, 100, 300):  # in a face, at a face's end, in the faces, in the vertices
        (tmp_path / "cut.ply").write_bytes(whole[:-cut])
        with pytest.raises(InputError, match="cut.ply' (has .* bytes, and what its header|claims)"):
            to_surface(tmp_path / "cut.ply")


def test_a_depth_map_that_claims_to_be_huge(tmp_path):
    from pagas_cl.scene.depthmap import load_depth

    (tmp_path / "a.pfm").write_bytes(b"Pf\n900000 900000\n-1.0\n" + bytes(100))
    (tmp_path / "b.geometric.bin").write_bytes(b"900000&900000&1&" + bytes(100))
    np.save(tmp_path / "c.npy", np.zeros((2, 2), np.float32))
    raw = (tmp_path / "c.npy").read_bytes().replace(b"(2, 2)", b"(900000, 900000)", 1)
    (tmp_path / "c.npy").write_bytes(raw)
    for name in ("a.pfm", "b.geometric.bin", "c.npy"):
        with bounded(), pytest.raises(InputError):
            load_depth(tmp_path / name)
