"""Real photos: the castle of Sceaux at an eighth of its size, from its mesh, in a terminal."""

import json
from dataclasses import replace

import numpy as np
import pytest
from paths.run import in_pipe, in_terminal
from paths.table import ON_A_TERMINAL
from PIL import Image

from pagas_cl import save_depth
from pagas_cl.refine import initial_depths
from pagas_cl.scene.images import write_image
from pagas_cl.scene.meshes.kinds import to_surface
from pagas_cl.scene.readers import camera_file, read_scene

pytestmark = pytest.mark.slow

SIZE = 354, 266
HELD_OUT = "00004.png"


@pytest.fixture(scope="module")
def castle(data_dir, tmp_path_factory):
    """Six of its views, and the depth maps of its mesh in maps/."""
    given = data_dir / "sceaux_castle"
    if not given.is_dir():
        pytest.skip(f"the castle is not here: {given} does not exist")
    folder, views = tmp_path_factory.mktemp("castle"), []
    (folder / "images").mkdir()
    for view in read_scene(given).views[2:8]:
        photo = Image.open(view.image).resize(SIZE, Image.Resampling.BOX)
        write_image(folder / "images" / f"{view.stem}.png", np.asarray(photo))
        views.append(replace(view, camera=view.camera.resized(*SIZE), name=f"{view.stem}.png"))
    camera_file.write(folder, views)
    mesh = given / "scene_mesh.ply"
    for view, depth in zip(views, initial_depths(to_surface(mesh), views)):
        save_depth(folder / "maps" / f"{view.stem}.npz", depth)
    return folder, mesh


def test_a_held_out_photo_agrees_better(castle, tmp_path):
    folder, mesh = castle
    ran = in_terminal(["refine", str(folder), "--mesh", str(mesh), "--hold-out", HELD_OUT, "--set", "pyramid.steps=50",
                       "--output", str(tmp_path / "made.ply"), "--save-depth", str(tmp_path / "maps"),
                       *ON_A_TERMINAL])
    ran.must_end_well(0)
    assert "━" in ran.raw and (tmp_path / "made.ply").stat().st_size > 0.5 * mesh.stat().st_size
    for result, start in ((tmp_path / "maps", folder / "maps"), (tmp_path / "made.ply", mesh)):
        judged = in_pipe(["evaluate", str(result), "--scene", str(folder), "--held-out", HELD_OUT, "--before",
                          str(start), "--json", str(tmp_path / "figures.json"), "--overwrite"])
        judged.must_end_well(0)
        rows = json.loads((tmp_path / "figures.json").read_text())["figures"]["correlation of held-out photos"].values()
        after, before = (np.array([row[name] for row in rows]) for name in ("median", "median_before"))
        assert len(after) >= 4 and after.mean() > before.mean() + 0.003, (before, after)
