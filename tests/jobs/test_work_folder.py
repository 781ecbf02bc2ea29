"""A folder of results may come from anywhere: what is read in its work folder leads nowhere outside of it."""

import json
import os
from dataclasses import asdict

import pytest
from support.job_scenes import NOT_MEASURED, write_small_scene

import pagas_cl.__main__ as command_line
from pagas_cl.errors import InputError
from pagas_cl.jobs.finished import _seal, records_in, users_of
from pagas_cl.jobs.task import Record
from pagas_cl.jobs.work_folder import check_names, claim_names, one_run, remove_run

STEMS = ["../victim", "../../victim", "a/../../victim", "{outside}/victim", "link/victim", "./link/victim",
         ".pagas_cl/victim", "", ".", "..", "/", "victim\0", 5, None, ["../victim"], {"../victim": 1}]


@pytest.fixture
def outside(tmp_path):
    """A folder with victims, linked to from the folder of results next to it."""
    (tmp_path / "outside").mkdir()
    out = tmp_path / "out"
    (out / ".pagas_cl").mkdir(parents=True)
    (out / "link").symlink_to(tmp_path / "outside")
    for folder in (tmp_path, tmp_path / "outside", tmp_path.parent):
        (folder / "victim.npz").write_text("precious")
    return tmp_path / "outside"


def victims(outside) -> list[str]:
    return [(folder / "victim.npz").read_text() for folder in (outside, outside.parent, outside.parent.parent)]


@pytest.mark.parametrize("stem", STEMS)
@pytest.mark.parametrize("form", ["list", "mapping", "word"])
def test_names_lead_nowhere_outside(outside, stem, form):
    out = outside.parent / "out"
    stem = stem.format(outside=outside) if isinstance(stem, str) else stem
    content = {"list": [stem, "own"], "mapping": {str(stem): 1}, "word": str(stem)}[form]
    (out / ".pagas_cl/names.json").write_text(json.dumps(content))
    (out / "own.npz").write_text("a depth map")
    remove_run(out)
    assert victims(outside) == ["precious"] * 3
    assert (out / "own.npz").exists() == (form != "list") and (out / "link").is_symlink()


@pytest.mark.parametrize("stem", [stem for stem in STEMS if isinstance(stem, str)])
def test_records_lead_nowhere_outside(outside, stem):
    out, views = outside.parent / "out", outside.parent / "out/.pagas_cl/views"
    views.mkdir()
    stem = stem.format(outside=outside)
    for number, (own, digests) in enumerate(((stem, {}), ("r1", {f"{stem}.npz": ""}), ("r2", {str(outside): ""}))):
        known = json.loads(json.dumps(asdict(Record("name", own, "key", digests=digests))))
        (views / f"r{number}.json").write_text(json.dumps({"seal": _seal(known), **known}))
    assert records_in(out) == [] and users_of(out) == {}


@pytest.mark.parametrize("link", [".pagas_cl", ".pagas_cl/views", ".pagas_cl/journal", ".pagas_cl/names.json"])
def test_a_work_folder_that_is_a_link_is_refused(tmp_path, link):
    (tmp_path / "other").mkdir()
    (tmp_path / "out" / link).parent.mkdir(parents=True)
    (tmp_path / "out" / link).symlink_to(tmp_path / "other")
    with pytest.raises(InputError, match="is a link"), one_run(tmp_path / "out"):
        pytest.fail("begun")
    assert not list((tmp_path / "other").iterdir())


def test_depth_maps_are_not_written_through_a_link(outside):
    out = outside.parent / "out"
    for overwrite in (False, True):
        with pytest.raises(InputError, match="through a link"):
            claim_names(out, ["link/victim"], overwrite)
    check_names(out, ["own", "folder/own"])
    assert not (out / ".pagas_cl/names.json").exists()


def test_empty_work_folders_do_not_stay(tmp_path):
    with one_run(tmp_path / "new"):
        for name in ("parts", "views/left", "inputs"):
            (tmp_path / "new/.pagas_cl" / name).mkdir(parents=True)
    assert not list(tmp_path.iterdir())


def test_a_system_that_removes_no_open_file(tmp_path, monkeypatch):
    """As Windows: the run's lock is open while it is held."""
    whole = os.unlink

    def unlink(path, **where):
        if os.path.realpath(path) in [os.path.realpath(f"/proc/self/fd/{n}") for n in os.listdir("/proc/self/fd")]:
            raise PermissionError(13, "used by another process", str(path))
        whole(path, **where)

    monkeypatch.setattr(os, "unlink", unlink)
    with one_run(tmp_path / "new"):
        assert [path.name for path in (tmp_path / "new/.pagas_cl").iterdir()] == ["lock"]
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_downloaded_folder_deletes_nothing_outside(tmp_path, outside):
    """What lies hidden next to the mesh that is written."""
    scene = write_small_scene(tmp_path / "scene", 3)
    hidden = tmp_path / "out" / ".fine.ply.views" / ".pagas_cl"
    hidden.mkdir(parents=True)
    (hidden / "names.json").write_text(json.dumps(["../../victim", "../../../victim", str(outside / "victim")]))
    assert command_line.run(["refine", str(scene), "--mesh", str(scene / "mesh_coarse.ply"), "--output",
                             str(tmp_path / "out/fine.ply"), "--set", "pyramid.steps=2", *NOT_MEASURED]) == 0
    assert victims(outside) == ["precious"] * 3 and not hidden.exists()
