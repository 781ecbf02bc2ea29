"""`pagas-cl analyze`, effects by name everywhere, and whether views that contradict each other are found."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from support.scenes import relief_scene
from support.synthetic.scene import write_scene

from pagas_cl.__main__ import run
from pagas_cl.config import Effects
from pagas_cl.config.presets import BALANCED, build_config, effect_settings
from pagas_cl.errors import InputError
from pagas_cl.method.effects.decide import CONTRADICTED, EFFECTS, Decision, decide_consistency
from pagas_cl.method.surface.agree import contradicted
from pagas_cl.method.surface.mesh_options import MeshOptions
from pagas_cl.method.view.one_view import refine_depth

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def made():
    return relief_scene(96, 72, 3, held_out=0, exposure=0.3)


@pytest.fixture(scope="module")
def scene(made, device, tmp_path_factory):
    return write_scene(made, tmp_path_factory.mktemp("scene"))


def test_the_command_writes_table_and_json(made, scene, tmp_path, capsys):
    assert run(["analyze", str(scene), "--depth-dir", str(scene / "depth_initial"), "--views", "target", "--json",
                str(tmp_path / "all.json"), "--quiet"]) == 0
    printed = capsys.readouterr().out
    content = json.loads((tmp_path / "all.json").read_text())
    view, = content["views"]
    assert [effect["effect"] for effect in view["effects"]] == list(EFFECTS)
    exposure = next(effect for effect in view["effects"] if effect["effect"] == "exposure")
    assert exposure["on"] and exposure["evidence"] > exposure["threshold"] == EFFECTS["exposure"].threshold
    assert all(name in printed and content["costs"][name]["seconds_on"] > 0 for name in EFFECTS)
    assert content["costs"]["exposure"]["device_bytes"] > 0 and content["costs"]["noise"]["device_bytes"] == 0


def test_the_command_follows_what_is_requested(scene, capsys):
    assert run(["analyze", str(scene), "--depth-dir", str(scene / "depth_initial"), "--views", "target", "--no-costs",
                "--effect", "exposure=off", "--quiet"]) == 0
    assert "requested: off" in capsys.readouterr().out


def test_decisions_are_those_of_refine_where_photos_are_relit(device):
    """Once context photos are relit they are measured again: what else is needed, those show."""
    from pagas_cl.app.commands.analyze import analyze

    made = relief_scene(96, 72, 3, held_out=0, steps=0)
    fall = 1 - 0.5 * np.hypot(*np.meshgrid(np.linspace(-1, 1, 96), np.linspace(-0.75, 0.75, 72)))**2 / 1.6
    views = [replace(view, image=(view.load_image() * (fall if k % 2 else 1.5 - fall)[..., None]).astype(np.uint8))
             for k, view in enumerate(made.views)]
    depths = [made.initial_depth(view.camera) for view in made.views]
    found = analyze(views, depths, names=["target"], device=device)
    taken = {effect["effect"]: effect for effect in refine_depth(views[0], views[1:], depths[0]).report["effects"]}
    assert taken["shading"]["on"] and [decision.as_dict() for decision in found.views[0].decisions] == [
        taken[name] for name in EFFECTS]
    assert list(found.costs)[:len(EFFECTS)] == list(EFFECTS)


def test_views_are_refined_where_a_preset_leaves_nothing_to_decide(scene, capsys):
    assert run(["analyze", str(scene), "--depth-dir", str(scene / "depth_initial"), "--preset", "fast", "--quiet"]) == 0
    assert capsys.readouterr().out.startswith("4 views\n\nNot needed:\n  pyramid ")


def test_cameras_that_are_off_are_reported_with_their_cost(made, device):
    from support.camera_noise import noisy

    from pagas_cl.app.commands.analyze import analyze, summary

    views = [replace(view, camera=camera) for view, camera in
             zip(made.views, noisy([view.camera for view in made.views], 1.0, 0))]
    found = analyze(views, [made.initial_depth(view.camera) for view in made.views], names=["target"], device=device)
    content = " ".join(line.strip() for line in summary(found))
    assert found.cameras.on and found.costs["cameras"].on > 0
    assert "cameras scene epipolar residual, pixels" in " ".join(content.split()) and "a view" in content


def test_a_summary_comes_first_and_the_table_on_demand(scene, capsys):
    """Nothing is wider than 80 columns, one row of the table is one line, times and sizes are as people say them."""
    arguments = ["analyze", str(scene), "--depth-dir", str(scene / "depth_initial"), "--quiet"]
    assert run([*arguments, "--no-costs"]) == 0
    short = capsys.readouterr().out
    assert run([*arguments, "--table", "--views", "target", "context_00"]) == 0
    long = capsys.readouterr().out
    assert all(len(line) <= 80 and not set(line) & set("┃│") for line in (short + long).splitlines())
    assert short.startswith("4 views\n\nNeeded:\n") and "Not needed:" in short and "evidence" not in short
    exposure = short[short.index("  exposure "):]
    assert exposure.startswith("  exposure        4 of 4 views") and "(on above 0.012)" in " ".join(exposure.split())
    rows = [line.split() for line in long[long.index("\nview "):].splitlines()
            if line.startswith(("target", "context"))]
    assert [row[1] for row in rows] == 2 * list(EFFECTS) and {row[4] for row in rows} == {"on", "off"}
    costs = long[long.index("\neffect "):].splitlines()[2:]
    assert [line.split()[0] for line in costs] == list(EFFECTS)
    assert all(line.split()[2] in ("s", "ms") and line.split()[-1] in ("kB", "MB") for line in costs)


@pytest.mark.parametrize("options, sentence", [
    (["--depth-dir", "nowhere", "--mesh", "m.ply"], "got both"), (["--effect", "exposure"], "has no '='"),
    (["--effect", "exposure=maybe"], "effects.exposure is 'maybe'"),
    (["--effect", "glow=on"], "unknown setting 'effects.glow'")])
def test_bad_requests_are_one_sentence(scene, capsys, options, sentence):
    more = [] if "--depth-dir" in options else ["--depth-dir", str(scene / "depth_initial")]
    assert run(["analyze", str(scene), *more, *options]) == 2
    assert sentence in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("name", [f for f in vars(Effects())])
def test_every_effect_has_one_name_everywhere(name):
    """The same word in the API, on the command line and in .mlx."""
    parameters = pytest.importorskip("pagas_cl.filters.parameters")
    want = BALANCED.with_settings(**{f"effects__{name}": "off"})
    assert build_config("balanced", effect_settings([f"{name}=off"])) == want
    assert build_config("balanced", [f"effects.{name}=off"]) == want
    assert parameters.request({"effects": f"{name}=off"}, "here").config == want


def test_effects_need_a_choice():
    with pytest.raises(InputError, match="such as exposure=off"):
        effect_settings(["exposure"])


@pytest.fixture(scope="module")
def maps(made):
    cameras = made.cameras[:4]
    return cameras, [made.true_depth(camera) for camera in cameras]


def test_true_depths_do_not_contradict_each_other(maps):
    config, decision = decide_consistency(*maps, BALANCED)
    assert decision.evidence < CONTRADICTED / 2 and not decision.on and config.fusion.agree_views == 0


def test_a_view_that_is_off_is_found(maps, made):
    cameras, depths = maps
    wrong = [depths[0] - np.float32(6 * made.relief.parallax), *depths[1:]]
    config, decision = decide_consistency(cameras, wrong, BALANCED)
    assert decision.evidence > CONTRADICTED and decision.on and config.fusion.agree_views == 1
    assert contradicted(cameras, wrong, 2.0) == decision.evidence
    assert decide_consistency(cameras, wrong, config) == (config, None)       # decided


@pytest.mark.parametrize("choice, agree", [("on", 1), ("off", 0)])
def test_consistency_as_requested(maps, choice, agree):
    config, decision = decide_consistency(*maps, BALANCED.with_settings(effects__consistency=choice))
    assert config.fusion.agree_views == agree and decision.on == bool(agree)


def test_consistency_leaves_alone_what_is_set(maps):
    config = BALANCED.with_settings(fusion__agree_views=2)
    assert decide_consistency(*maps, config) == (config, None)
    two = decide_consistency(maps[0][:2], maps[1][:2], BALANCED)[1]
    assert not two.on and "three views" in two.reason


def test_fusion_drops_what_others_contradict(maps, made):
    pytest.importorskip("open3d")
    from pagas_cl.jobs.fusing import fuse_results
    from pagas_cl.result import DepthResult

    cameras, depths = maps
    floating = depths[0].copy()
    floating[15:60, 20:75] -= np.float32(8 * made.relief.parallax)
    results = [DepthResult.unrefined(camera, depth, "") for camera, depth in zip(cameras, [floating, *depths[1:]])]
    content = []
    near = {}
    for choice in ("off", "auto"):
        surface = fuse_results(made.views, results, BALANCED.with_settings(effects__consistency=choice),
                               making=MeshOptions(note=content.append))
        uv, z = cameras[0].project(surface.vertices)
        inside = (uv >= 0).all(axis=1) & (uv < (96, 72)).all(axis=1)
        true = depths[0][uv[inside].astype(int)[:, 1], uv[inside].astype(int)[:, 0]]
        near[choice] = float((z[inside] < true - 4 * made.relief.parallax).mean())
    assert "consistency off" in content[0] and "consistency on" in content[1]
    assert near["auto"] < 0.5 * near["off"]


def test_timed_steps_have_room_for_their_losses(made, device, monkeypatch):
    """Five steps are timed whatever the settings ask for: two of them would leave room for three losses."""
    from pagas_cl.app.commands.analyze import time_step
    from pagas_cl.method.splat import PhotoStore, ViewInput
    from pagas_cl.method.splat.level import Level

    plain, rooms = Level.run, []

    def run_steps(level, steps, progress=None, schedule=None):
        rooms.append(level.buffers.history.size // 4 - steps)
        # never past the end, on no device
        return plain(level, steps, progress, schedule) if rooms[-1] >= 0 else steps

    monkeypatch.setattr(Level, "run", run_steps)
    config = BALANCED.with_settings(pyramid__scales=(0.5, 1.0), pyramid__steps=(1, 2), solver__patience=5)
    target, *contexts = made.views
    given = ViewInput(target, contexts, made.initial_depth(target.camera), device, PhotoStore(device))
    seconds, _ = time_step(given, config)
    assert rooms and min(rooms) >= 0 and seconds > 0


def test_many_views_are_summed_up():
    """Their count stands apart from what follows; evidence is ordered as numbers."""
    from pagas_cl.app.commands.analyze import Analysis, ViewAnalysis, summary

    found = [ViewAnalysis("a", ("b",), (Decision("noise", evidence, 1.4, True, "noise"),), None)
             for evidence in (12.0, 9.5)]
    lines = summary(Analysis((*found * 100,), {}, "", ""))
    assert any("200 of 200 views noise: 9.5 to 12 (on above 1.4)" in line for line in lines), lines
