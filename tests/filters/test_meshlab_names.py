"""pymeshlab's own ways to call a filter have the PAGaS step, under one name."""

import numpy as np
import pytest
from support.scenes import relief_scene

from pagas_cl.errors import InputError
from pagas_cl.filters.history import METHOD, NOTE

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def pymeshlab():
    found = pytest.importorskip("pymeshlab")
    from pagas_cl.filters.pymeshlab_step import register

    register()
    register()      # twice is once
    return found


def test_it_is_applied_by_name_and_its_progress_shows(pymeshlab, tmp_path, capfd):
    made = relief_scene(64, 48, 2, held_out=0)
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(*(np.asarray(part) for part in made.initial_mesh(8.0))), "coarse")
    counts = meshes.apply_filter(METHOD, scene=made.views, preset="fast", context_views=2)
    assert counts["refined"] > 0 and meshes.mesh_number() == 2
    assert "refine: 3 of 3" in capfd.readouterr().err
    meshes.apply_filter("compute_normal_per_vertex")
    meshes.save_filter_script(filter_script_name=str(tmp_path / "s.mlx"))
    assert "filter" in pymeshlab.MeshSet.apply_filter.__doc__       # pymeshlab's own help
    text = (tmp_path / "s.mlx").read_text()
    assert text.count(NOTE) == 1 and "run_script" in NOTE and "pagas-cl script" in NOTE
    again = pymeshlab.MeshSet()
    again.create_sphere()
    again.load_filter_script(str(tmp_path / "s.mlx"))
    capfd.readouterr()
    again.print_filter_script()        # all that pymeshlab prints by itself, registered or not
    assert "run_with : str = 'pagas_cl.filters.filter_script.run_script" in capfd.readouterr().out
    with pytest.raises(InputError, match="run it with pagas_cl.filters.filter_script.run_script"):
        again.apply_filter_script()


@pytest.mark.parametrize("name", ["contextViews", "context_views"])
def test_a_script_spells_parameters_as_python_does(pymeshlab, tmp_path, name):
    from pagas_cl.filters.filter_script import check_script

    (tmp_path / "s.mlx").write_text('<!DOCTYPE FilterScript>\n<FilterScript><filter name="PAGaS Depth Refinement">'
                                    f'<Param type="RichInt" name="{name}" value="3"/></filter></FilterScript>')
    step, = check_script(tmp_path / "s.mlx")
    assert step.request.config.context.number == 3
