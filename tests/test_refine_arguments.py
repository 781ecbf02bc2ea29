"""What the public functions refuse before they work, and how results find their views again."""

import json
import pickle

import numpy as np
import pytest
from conftest import look_at

import pagas_cl
from pagas_cl.errors import InputError
from pagas_cl.result import DepthResult
from pagas_cl.scene.images import Loads
from pagas_cl.scene.view import View, joined

DEPTH = np.ones((4, 6), np.float32)


def view_at(x, name):
    return View(look_at((x, 0, -5), (0, 0, 0), 6, 4, 5.0), np.zeros((4, 6, 3), np.uint8), name=name)


VIEWS = [view_at(0, "a.png"), view_at(1, "b.png"), view_at(2, "c.png")]
CALLS = {
    "refine_mesh": lambda **given: pagas_cl.refine_mesh(([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]),
                                                        [view.camera for view in VIEWS],
                                                        [view.image for view in VIEWS], **given),
    "refine_depth": lambda **given: pagas_cl.refine_depth(VIEWS[0], VIEWS[1:], DEPTH, **given),
    "refine_views": lambda **given: pagas_cl.refine_views(VIEWS, [DEPTH] * 3, **given),
}


def result_of(view):
    return DepthResult.unrefined(view.camera, DEPTH, "", name=view.name)


@pytest.mark.parametrize("name", CALLS)
def test_a_config_with_a_preset_is_refused(name):
    for preset in ("balanced", "fast"):
        with pytest.raises(InputError, match=f"preset '{preset}' and a config were given, expected one of the two"):
            CALLS[name](preset=preset, config=pagas_cl.preset("fast"))
    with pytest.raises(InputError, match="unknown preset 'fats', expected 'fast' or"):
        CALLS[name](preset="fats")
    with pytest.raises(InputError, match="config is a str, expected pagas_cl.Config"):
        CALLS[name](config="fast")


def test_settings_take_numbers_of_numpy():
    numbers = {"context__number": np.int64(4), "splatting__radius": np.float64(1.25), "pyramid__steps": np.array([20])}
    made = pagas_cl.preset("fast").with_settings(**numbers)
    assert made == pagas_cl.preset("fast").with_settings(context__number=4, splatting__radius=1.25, pyramid__steps=[20])
    for name, given in (("steps", 20), ("scales", None), ("far_off", "half")):        # an int was a traceback
        with pytest.raises(InputError, match=f"setting pyramid.{name} is .{{2,6}}, expected a list of numbers"):
            made.with_settings(**{f"pyramid__{name}": given})
    assert json.loads(json.dumps(made.as_dict()))["context"]["number"] == 4 and "np." not in repr(made)


@pytest.mark.parametrize("given, sentence", [
    ({"device": [pagas_cl.Device]}, "device is a type, expected .*a list of names, or pagas_cl.Device.of"),
    ({"folder": ""}, "folder is '', expected the path of a folder"),
])
def test_a_place_that_is_none_is_refused(given, sentence):
    with pytest.raises(InputError, match=sentence):
        CALLS["refine_views"](**given)


def test_neither_means_balanced():
    from pagas_cl.config.presets import settings_of

    assert settings_of(None, None) == pagas_cl.preset("balanced")
    assert settings_of("fast", None) == pagas_cl.preset("fast")
    assert settings_of(None, pagas_cl.preset("paper")) == pagas_cl.preset("paper")


def test_a_result_says_whose_it_is():
    result = pagas_cl.refine_depth(VIEWS[0], [], DEPTH)
    assert result.name == "a.png" and result.reason
    camera = look_at((0, 0, -5), (0, 0, 0), 6, 4, 5.0)
    assert DepthResult.missing(camera, "lost", "b.png").name == "b.png"
    assert DepthResult.missing(camera, "lost").name == camera.name


@pytest.mark.parametrize("contexts, held_out, sentence", [
    (VIEWS, [], "'a.png' is given as target and as one of contexts"),
    (VIEWS[1:], VIEWS[:1], "'a.png' is given as target and as one of held_out"),
    (VIEWS[1:], VIEWS[2:], "'c.png' is given as one of contexts and as one of held_out")])
def test_a_photo_does_not_judge_itself(contexts, held_out, sentence):
    """All views as contexts, the target among them, left it unchanged: "are the cameras right?"."""
    with pytest.raises(InputError, match=sentence):
        pagas_cl.refine_depth(VIEWS[0], contexts, DEPTH, held_out=held_out)


def test_a_photo_that_was_read_twice_is_the_same(tmp_path):
    file = tmp_path / "a.png"
    target, again = (View(VIEWS[0].camera, path, name=name) for path, name in ((file, "a"), (str(file), "b")))
    with pytest.raises(InputError, match="'a' is given as target and as one of contexts"):
        pagas_cl.refine_depth(target, [again], DEPTH)


def test_results_that_were_pickled_find_their_views():
    results = pickle.loads(pickle.dumps([result_of(VIEWS[2]), result_of(VIEWS[0])]))
    assert results[0].camera is not VIEWS[2].camera
    assert joined(VIEWS, results) == [(2, results[0]), (0, results[1])]
    assert joined(VIEWS[:2], results) == [(0, results[1])]


def test_views_of_one_name_differ_by_their_cameras():
    views = [view_at(x, "photo.png") for x in range(3)]
    results = pickle.loads(pickle.dumps([result_of(view) for view in views[1:]]))
    assert joined(views, results) == [(1, results[0]), (2, results[1])]
    twins = [view_at(0, "photo.png") for _ in range(2)]
    own = [result_of(view) for view in twins]
    assert joined(twins, own) == [(0, own[0]), (1, own[1])]
    with pytest.raises(InputError, match="2 views are called 'photo.png' and have the same camera"):
        joined(twins, pickle.loads(pickle.dumps(own)))


def test_two_results_of_one_view_are_refused():
    with pytest.raises(InputError, match="there are two results of view 'b.png', expected one"):
        joined(VIEWS, [result_of(VIEWS[1]), result_of(VIEWS[1])])


def test_fused_meshes_of_pickled_results_are_the_same():
    pytest.importorskip("open3d")
    from support.scenes import tiny

    from pagas_cl.jobs.fusing import fuse_results

    made, config = tiny(), pagas_cl.preset("fast").with_settings(effects__consistency="off", fusion__min_views=1)
    results = [DepthResult.unrefined(view.camera, made.initial_depth(view.camera), "", name=view.name)
               for view in made.views]
    one, other = (fuse_results(made.views, given, config)
                  for given in (results, pickle.loads(pickle.dumps(results[::-1]))))
    assert len(one.faces) > 100
    assert one.vertices.tobytes() == other.vertices.tobytes() and one.faces.tobytes() == other.faces.tobytes()


def test_what_loads_is_found_by_protocol():
    from pagas_cl.jobs.work_folder import StoredArray
    from pagas_cl.scene.depth.source import DepthSource

    for kind in (DepthSource, StoredArray):
        assert isinstance(kind.__new__(kind), Loads)
    assert not isinstance(DEPTH, Loads)
