"""Runs that are interrupted, gone on with, or that keep photos out, say so."""

import errno
import json
import re
import shutil

import numpy as np
import pytest
from support.job_scenes import NOT_MEASURED
from support.scenes import relief_scene
from support.synthetic.scene import write_scene

import pagas_cl.__main__ as command_line
from pagas_cl.jobs.finished import records_in
from pagas_cl.scene.depthmap import load_depth

pytestmark = pytest.mark.slow

NAMES = ["context_00", "context_01", "context_02", "context_03", "held_out_0", "target"]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_scene(relief_scene(64, 48, 4, held_out=1), tmp_path_factory.mktemp("lines") / "scene")


def refine(scene, out, *more):
    return command_line.run(["refine", str(scene), "--depth-dir", str(scene / "depth_initial"), "--save-depth",
                             str(out), "--set", "pyramid.steps=3", *NOT_MEASURED, *map(str, more)])


def interrupt_after(number, monkeypatch):
    """Ctrl-C when so many views have been refined, at whichever sizes."""
    import pagas_cl.method.view.one_view as refining

    whole, done = refining.fit_memory, []

    def until(*arguments, **keywords):
        if len(done) == number:
            raise KeyboardInterrupt
        done.append(1)
        return whole(*arguments, **keywords)

    monkeypatch.setattr(refining, "fit_memory", until)


@pytest.mark.parametrize("at, agreement, how", [(0, "off", ""), (2, "off", "finished"), (2, "on", "begun")])
def test_ctrl_c_says_what_is_kept_and_the_next_run_begins_with_it(scene, tmp_path, monkeypatch, capsys, at, agreement,
                                                                  how):
    """Views are begun until the last round of agreement."""
    interrupt_after(at, monkeypatch)
    rounds = "--effect", f"agreement={agreement}"
    assert refine(scene, tmp_path / "out", *rounds) == 130
    last = capsys.readouterr().err.splitlines()[-1]
    if at == 0:
        assert last == "pagas-cl: interrupted; nothing is kept, no view was finished"
        return
    assert last.startswith(f"pagas-cl: interrupted; 2 of 6 views are {how} and kept in ")
    assert "the same command goes on" in last
    monkeypatch.undo()
    assert refine(scene, tmp_path / "out", *rounds) == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("INFO")]
    of_runs = [k for k, line in enumerate(lines) if "earlier run" in line]
    assert f"an earlier run has left 2 {how} views" in lines[of_runs[0]]
    assert "2 of 6 views were finished by an earlier run and are kept" in lines[of_runs[1]]
    assert all(k < of_runs[0] or "of device memory" not in lines[k] for k in range(of_runs[1])), "before the work"


@pytest.mark.parametrize("status", [130, 1])
def test_where_nothing_is_kept_no_folder_stays(scene, tmp_path, monkeypatch, status):
    """Ctrl-C before a view is finished, or a disk that is full before one is begun."""
    save, saved = np.save, []

    def until_full(*arguments):
        if len(saved) == 2:
            raise OSError(errno.ENOSPC, "No space left on device")
        saved.append(save(*arguments))

    interrupt_after(0, monkeypatch)
    if status == 1:
        monkeypatch.setattr(np, "save", until_full)
    line = ["refine", str(scene), "--mesh", str(scene / "mesh_coarse.ply"), "--output", str(tmp_path / "fine.ply")]
    assert command_line.run([*line, *NOT_MEASURED]) == status and not list(tmp_path.iterdir())


def test_a_view_that_is_named_twice_counts_once(scene, tmp_path, monkeypatch, capsys):
    interrupt_after(1, monkeypatch)
    assert refine(scene, tmp_path / "out", "--views", *NAMES[:2], f"{NAMES[0]}.png", "--effect", "agreement=off") == 130
    assert "interrupted; 1 of 2 views are finished and kept in " in last_line(capsys)


def test_depth_maps_of_earlier_runs_are_counted_in_the_end(scene, tmp_path, capsys):
    out, end = tmp_path / "out", f"the refined depth maps: {tmp_path / 'out'}"
    assert refine(scene, out, "--views", *NAMES[:3], "--effect", "agreement=off") == 0
    assert f"{end}\n" in capsys.readouterr().err
    assert refine(scene, out, "--views", *NAMES[2:4], "--effect", "agreement=off") == 0
    assert f"{end} (with 2 more, of earlier runs: " in capsys.readouterr().err
    (out / f"{NAMES[0]}.npz").unlink()
    assert refine(scene, out, "--views", *NAMES[2:4], "--effect", "agreement=off") == 0
    assert f"{end} (with 1 more, of earlier runs: " in capsys.readouterr().err


def test_ctrl_c_counts_what_smaller_sizes_have_left(scene, tmp_path, monkeypatch, capsys):
    interrupt_after(3, monkeypatch)
    sizes = "--effect", "pyramid=on"
    assert refine(scene, tmp_path / "out", *sizes) == 130
    assert "interrupted; 3 of 6 views are begun and kept in " in last_line(capsys)
    monkeypatch.undo()
    assert refine(scene, tmp_path / "out", *sizes) == 0
    assert "an earlier run has left 3 begun views" in capsys.readouterr().err


def test_held_out_photos_take_no_part_at_all(scene, tmp_path, capsys):
    out = tmp_path / "out"
    assert refine(scene, out, "--hold-out", "held_out_0", "context_03.png") == 0
    assert "held out, and seen by nothing: context_03.png, held_out_0.png" in capsys.readouterr().err
    records = records_in(out)
    assert sorted(record.stem for record in records) == [n for n in NAMES if n not in ("held_out_0", "context_03")]
    seen = {name for r in records for name in (*r.report["contexts"], *r.report["held_out"])}
    assert seen and not seen & {"held_out_0.png", "context_03.png"}
    # as if they were not there
    less = shutil.copytree(scene, tmp_path / "less")
    kept = json.loads((less / "cameras.json").read_text())
    kept["views"] = [v for v in kept["views"] if v["image"] not in ("held_out_0.png", "context_03.png")]
    (less / "cameras.json").write_text(json.dumps(kept))
    assert refine(less, tmp_path / "other") == 0
    for record in records:
        assert np.array_equal(*(load_depth(where / f"{record.stem}.npz") for where in (out, tmp_path / "other")))


def evaluate(scene, out, name, *more):
    return command_line.run(["evaluate", str(out), "--scene", str(scene), "--held-out", name, *map(str, more)])


def last_line(capsys) -> str:
    return capsys.readouterr().err.splitlines()[-1]


def test_a_run_ends_with_what_photos_say_that_took_no_part_and_its_page_begins_with_it(scene, tmp_path, capsys):
    more = "--context", "2", "--set", "pyramid.steps=30"
    assert refine(scene, tmp_path / "out", *more, "--report", tmp_path / "page") == 0
    said = last_line(capsys)
    assert re.fullmatch(r"INFO Photos that took no part agree better: \S+ before, \S+ after \(1 - correlation, median "
                        r"of 6 views; better on \d, worse on \d\)\.", said), said
    page = (tmp_path / "page" / "index.html").read_text()
    assert '<p class="headline">' + said.removeprefix("INFO ") in page
    assert refine(scene, tmp_path / "out", *more) == 0
    assert last_line(capsys) == said, "the same of views that an earlier run has finished"
    assert refine(scene, tmp_path / "few") == 0
    assert "was not measured, since every photo took part" in last_line(capsys)
    assert refine(scene, tmp_path / "held", "--hold-out", "context_01", "--report", tmp_path / "held_page") == 0
    said = last_line(capsys).removeprefix("INFO ")
    assert said.endswith("measured: compare by what was held out, with 'pagas-cl evaluate --held-out context_01'.")
    page = json.loads((tmp_path / "held_page" / "report.json").read_text())
    assert said in page["notes"] and page["facts"]["held out"] == "context_01"


def test_what_was_held_out_is_named_as_a_shell_takes_it(scene, tmp_path, capsys):
    shutil.copytree(scene, odd := tmp_path / "odd")
    (odd / "images" / "context_01.png").rename(odd / "images" / "held out; 1.png")
    cameras = odd / "cameras.json"
    cameras.write_text(cameras.read_text().replace("context_01.png", "held out; 1.png"))
    assert refine(odd, tmp_path / "held", "--hold-out", "held out; 1.png") == 0
    assert last_line(capsys).endswith(", with 'pagas-cl evaluate --held-out 'held out; 1.png''.")


def test_smaller_sizes_have_a_sentence_of_their_own(scene, tmp_path, capsys):
    assert refine(scene, tmp_path / "out", "--context", "2", "--effect", "pyramid=on") == 0
    assert "Smaller sizes came before that: " in last_line(capsys)


def test_meshes_and_depth_maps_are_compared_by_held_out_photos(scene, tmp_path, capsys):
    """The same figures of a mesh and of the depth maps drawn from it, as the result and as what was before."""
    mesh, maps = scene / "mesh_coarse.ply", scene / "depth_initial"
    tables = []
    for result, before in ((mesh, maps), (maps, mesh)):
        assert evaluate(scene, result, "held_out_0", "--before", before, "--json", tmp_path / "figures.json",
                        "--overwrite") == 0
        said = capsys.readouterr().out
        assert re.search(r"\(1 - correlation, median of 5 photo pairs; better on \d, worse on \d\)\.\n$", said), said
        tables.append(json.loads((tmp_path / "figures.json").read_text())["figures"]["correlation of held-out photos"])
    for name, row in tables[0].items():
        assert row["median"] == tables[1][name]["median_before"] and row["median"] != row["median_before"]
        assert row["median"] == pytest.approx(row["median_before"], abs=0.2)


@pytest.mark.parametrize("line, said", [
    ("evaluate {0}/mesh_coarse.ply --held-out target", "--scene is missing"),
    ("evaluate {0}/depth_initial {0}/depth_true --scene {0} --before {0}/mesh_coarse.ply", "name them with --held-out"),
    ("evaluate {0}/mesh_coarse.ply {0}/mesh_coarse.ply --scene {0}", "goes with a folder of depth maps or --held-out"),
    ("evaluate {0}/mesh_coarse.ply --scene {0} --held-out target --before nowhere.ply", "nowhere.ply"),
    ("evaluate {0}/mesh_coarse.ply", "nothing to compare")])
def test_what_is_not_compared_is_said_in_a_sentence(scene, capsys, line, said):
    assert command_line.run(line.format(scene).split()) == 2
    assert said in last_line(capsys)


def test_a_photo_that_took_part_is_no_judge(scene, tmp_path, capsys):
    assert refine(scene, tmp_path / "with", "--views", "target") == 0
    assert refine(scene, tmp_path / "without", "--views", "target", "--hold-out", "context_01") == 0
    capsys.readouterr()
    for name in ("context_01", "context_00.png"):        # a context view, or a judge
        assert evaluate(scene, tmp_path / "with", name) == 0
        assert "is no held-out photo" in capsys.readouterr().err
    assert evaluate(scene, tmp_path / "with", "context_01", "--before", scene / "depth_initial") == 0
    assert "took no part" not in capsys.readouterr().out
    assert evaluate(scene, tmp_path / "without", "context_01") == 0
    assert "is no held-out photo" not in capsys.readouterr().err


def test_a_depth_map_that_a_judge_has_of_an_earlier_run_is_no_part_of_it(scene, tmp_path, capsys):
    out = tmp_path / "out"
    assert refine(scene, out, "--views", "target", "context_01") == 0
    assert refine(scene, out, "--views", "target", "--hold-out", "context_01") == 0
    assert load_depth(out / "context_01.npz").any()
    capsys.readouterr()
    assert evaluate(scene, out, "context_01", "context_01.png", "--before", scene / "depth_initial") == 0
    said = capsys.readouterr()
    assert "is no held-out photo" not in said.err and "hotos that took no part" in said.out


def test_a_view_is_not_both_requested_and_held_out(scene, tmp_path, capsys):
    assert refine(scene, tmp_path / "out", "--views", "target", "--hold-out", "target.png") == 2
    assert "'target.png' is in --views and in --hold-out" in capsys.readouterr().err
    assert refine(scene, tmp_path / "out", "--hold-out", "nobody") == 2
    assert "there is no view 'nobody'" in capsys.readouterr().err
