"""Damaged files: each gives an InputError or a right result; never a crash, a hang, much memory, or a wrong camera.

A result is right when it is what an independent reading of the same bytes (oracles) gives.
PAGAS_FUZZ=2000 pytest tests/test_fuzz_*.py runs 2000 inputs for each reader and test; the default is few.
"""

import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support import mutations, rigs, scene_writers
from support.fuzzing import COUNT, bounded
from support.oracles import same
from support.scene_files import READERS

from pagas_cl.errors import InputError
from pagas_cl.scene.readers import read_scene

ONE = ("mvsnet", "mapanything", "polycam", "scannet", "7scenes")     # a file holds one camera


@pytest.fixture(scope="module", params=READERS)
def target(request, tmp_path_factory):
    """(format, folder, file that is damaged, independent reading, options)"""
    make, name, oracle, options = READERS[request.param]
    folder = tmp_path_factory.mktemp(request.param)
    views = rigs.with_photos(folder, rigs.random_cameras(
        1 if request.param in ONE else 3, centred=request.param == "bundler", square=request.param == "bundler",
        same=request.param in ("open3d_log", "colmap", "colmap_txt", "tum", "scannet", "7scenes", "dvmvs")))
    make(folder, views)
    return request.param.split("_")[0], folder, folder / name, oracle, options


def judge(format, folder, oracle, options, data: bytes) -> bool:
    """Whether the damaged file was read (rightly); False where it was refused."""
    try:
        with bounded():
            scene = read_scene(folder, format, **options)
    except InputError as error:
        assert 10 < len(str(error)) < 1200 and "\n" not in str(error).strip()
        return False
    try:
        expected = oracle(data)
    except Exception as error:
        raise AssertionError(f"read what an independent reading refuses: {error!r}") from error
    same(scene.cameras, expected)
    for camera in scene.cameras:
        camera.rays() if camera.width * camera.height < 1e6 else None
    return True


def test_damaged_bytes(target):
    format, folder, path, oracle, options = target
    original = path.read_bytes()
    assert judge(format, folder, oracle, options, original)
    rng = np.random.default_rng(7)
    outcomes = []
    try:
        for _ in range(COUNT):
            data = mutations.mutate(original, rng)
            path.write_bytes(data)
            try:
                outcomes.append(judge(format, folder, oracle, options, data))
            except BaseException:
                (folder / "failed").write_bytes(data)
                raise
    finally:
        path.write_bytes(original)
    assert len(outcomes) == COUNT and not all(outcomes)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8)
    | st.sampled_from(["images/x.png", 1e300]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=4), max_leaves=12)


def places(value, path=()):
    """Paths of all values in nested JSON."""
    yield path
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        yield from places(inner, path + (key,))


@pytest.mark.parametrize("name", ["nerfstudio", "open3d", "cameras", "record3d", "polycam"])
def test_any_json_value_anywhere(name, tmp_path):
    make, file, oracle, options = READERS[name]
    make(tmp_path, rigs.with_photos(tmp_path, rigs.random_cameras(1 if name in ONE else 2)))
    path = tmp_path / file
    original = json.loads(path.read_text())
    paths = list(places(original))

    @settings(max_examples=COUNT, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
    @given(st.sampled_from(paths), json_values)
    def run(place, value):
        changed = json.loads(json.dumps(original))
        if not place:
            changed = value
        else:
            holder = changed
            for key in place[:-1]:
                holder = holder[key]
            holder[place[-1]] = value
        data = json.dumps(changed).encode()
        path.write_bytes(data)
        judge(name, tmp_path, oracle, options, data)

    run()


def test_a_misspelt_key_never_changes_a_camera(tmp_path):
    """Optional keys have defaults, which must not replace a value whose key was damaged by one letter."""
    scene_writers.nerfstudio(tmp_path, rigs.with_photos(tmp_path, rigs.random_cameras(2)))
    path = tmp_path / "transforms.json"
    before = read_scene(tmp_path).cameras
    text = path.read_text()
    refused = 0
    for key in ("fl_x", "fl_y", "cx", "cy", "w", "h", "frames", "file_path", "transform_matrix", "camera_model"):
        for place in range(len(key)):
            for letter in "qX_0":
                path.write_text(text.replace(f'"{key}"', f'"{key[:place] + letter + key[place + 1:]}"', 1))
                try:
                    after = read_scene(tmp_path, "nerfstudio").cameras
                    assert max(map(rigs.worst_difference, before, after)) == 0
                except InputError:
                    refused += 1
    assert refused > 100
