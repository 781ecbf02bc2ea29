"""The mesh solve: vertices go where the refined depths are, all at once, and everything on the mesh stays."""

from dataclasses import replace

import numpy as np
import pytest
from support.scenes import relief_scene
from twins import mesh_evidence as evidence_twin
from twins import mesh_solve as solve_twin

from pagas_cl.errors import InputError
from pagas_cl.method.surface import mesh_levels
from pagas_cl.method.surface.mesh_collapse import simplified
from pagas_cl.method.surface.mesh_evidence import Observed
from pagas_cl.method.surface.mesh_levels import fit_mesh
from pagas_cl.method.surface.mesh_solve import solve_mesh
from pagas_cl.method.surface.on_vertices import footprints
from pagas_cl.method.surface.raster import each_depth
from pagas_cl.method.surface.subdivide import subdivide, with_middles
from pagas_cl.method.surface.weld import component_of, welded
from pagas_cl.scene.mesh import Material, Surface, Texture, grid_faces
from pagas_cl.scene.meshes.files import read_mesh, write_mesh
from pagas_cl.scene.meshes.kinds import with_vertices

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def made():
    return relief_scene(160, 120, contexts=4, held_out=0, steps=0)


@pytest.fixture(scope="module")
def coarse(made):
    return Surface(*made.initial_mesh(2.0))


def observed(made, change=lambda depth: depth):
    """The true depth maps, as sure as a tenth of a pixel of parallax."""
    return [Observed(camera, change(made.true_depth(camera)).astype(np.float32),
                     np.full((camera.height, camera.width), 0.1 * made.relief.parallax, np.float32))
            for camera in made.cameras[:5]]


def height_error(made, vertices):
    """Distance of vertices from the true relief along z, inside its middle part."""
    inner = (np.abs(vertices[:, 0]) < 90) & (np.abs(vertices[:, 1]) < 60)
    x, y, z = vertices[inner].T
    return np.abs(z - made.true_solid.height(x, y)[0])


def roof(made, device):
    """Two slopes that meet at right angles, and what views say of them moved by a way across the ridge."""
    pixel, side = made.relief.footprint, 6 * made.relief.footprint * np.arange(-6, 7)
    x, y = (part.ravel() for part in np.meshgrid(side, side))
    mesh = Surface(np.stack([x, y, abs(x)], axis=1), grid_faces(13, 13))
    moved, cameras = pixel * np.array([0.4, 0, -0.5]), made.cameras[:5]
    depths = each_depth(Surface(mesh.vertices + moved, mesh.faces), cameras, device)
    return mesh, moved, [Observed(camera, depth, np.full_like(depth, 0.1 * made.relief.parallax))
                         for camera, depth in zip(cameras, depths)]


def across(surface, vertices):
    a, b, c = (vertices[surface.faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


@pytest.mark.kernels
def test_vertices_go_onto_the_refined_surface(made, coarse, device):
    views = observed(made)
    result, again = (solve_mesh(coarse, views, device) for _ in range(2))
    assert np.array_equal(result.vertices, again.vertices) and np.array_equal(result.deviation, again.deviation)
    before, after = height_error(made, coarse.vertices), height_error(made, result.vertices)
    assert after.mean() < 0.3 * before.mean()  # what is left is detail finer than the mesh's edges
    inner = np.abs(coarse.vertices[:, :2]).max(axis=1) < 60
    assert (result.seen[inner] >= 2).mean() > 0.95
    assert np.isfinite(result.deviation[result.seen >= 2]).all() and np.isinf(result.deviation[result.seen < 2]).all()
    pixel = made.relief.footprint
    assert np.median(result.deviation[inner]) < 0.5 * pixel


def test_finer_edges_take_finer_detail(made, device):
    """A mesh with edges of 8 pixels holds only part of the detail; split to 1.5 pixels it holds it."""
    views, coarse = observed(made), Surface(*made.initial_mesh(8.0))
    size = footprints(coarse.vertices, [v.camera for v in views], [v.depth for v in views])
    fine = subdivide(coarse.vertices, coarse.faces, 1.5 * size)
    lifted = Surface(fine.vertices(coarse.vertices), fine.faces)
    assert (lifted.vertices[:len(coarse.vertices)] == coarse.vertices).all()

    def error(surface, vertices):
        return height_error(made, vertices[surface.faces].mean(axis=1)).mean()  # at the middles of the faces

    given = error(coarse, coarse.vertices)
    split = solve_mesh(lifted, views, device).vertices
    assert error(coarse, solve_mesh(coarse, views, device).vertices) < 0.9 * given
    assert error(lifted, split) < 0.25 * given


@pytest.mark.kernels
def test_nothing_moves_without_a_second_view_or_a_refined_depth(made, coarse, device):
    views = observed(made)
    unsure = [replace(v, deviation=np.full_like(v.deviation, np.inf)) for v in views]
    for few in (views[:1], unsure):
        assert np.array_equal(solve_mesh(coarse, few, device).vertices, coarse.vertices)


@pytest.mark.kernels
def test_views_that_disagree_do_not_move_the_mesh(made, coarse, device):
    far = 8 * made.relief.parallax
    apart = [replace(v, depth=v.depth + np.float32(k * far)) for k, v in enumerate(observed(made))]
    result = solve_mesh(coarse, apart, device)
    assert (result.seen >= 2).mean() < 0.02


@pytest.mark.kernels
def test_far_from_the_origin_and_in_other_units(made, coarse, device):
    """An offset of 5e6 and a factor of 1e3 change the moves by rounding only."""
    views, shift, factor = observed(made), np.array([450123.25, 4649876.5, 123.75]), 1e3
    moved = []
    for view in views:
        pose = view.camera.world_to_camera.copy()
        pose[:3, 3] = -pose[:3, :3] @ (factor * view.camera.center + shift)
        moved.append(Observed(replace(view.camera, world_to_camera=pose), view.depth * np.float32(factor),
                              view.deviation * np.float32(factor)))
    near = solve_mesh(coarse, views, device)
    far = solve_mesh(Surface(factor * coarse.vertices + shift, coarse.faces), moved, device)
    apart = np.abs((far.vertices - shift) / factor - near.vertices).max(axis=1)
    assert (apart > 1e-2 * made.relief.footprint).mean() < 2e-3      # vertices on a threshold
    assert np.percentile(apart, 99) < 2e-3 * made.relief.footprint


@pytest.mark.kernels
def test_seams_do_not_open(made, coarse, device):
    """Vertices that are there twice, as texture seams have them, stay together."""
    half, rest = np.array_split(coarse.faces, 2)
    doubled = Surface(np.concatenate([coarse.vertices] * 2), np.concatenate([half, rest + len(coarse.vertices)]))
    result = solve_mesh(doubled, observed(made), device)
    n = len(coarse.vertices)
    assert (result.vertices[:n] == result.vertices[n:]).all() and (result.vertices[:n] != coarse.vertices).any()


@pytest.mark.kernels
def test_no_triangle_is_turned_over(made, coarse, device):
    rng = np.random.default_rng(0)
    rough = coarse.vertices + rng.normal(scale=0.6 * made.relief.footprint, size=coarse.vertices.shape)
    result = solve_mesh(Surface(rough, coarse.faces), observed(made), device, rounds=1)
    assert result.held > 0 and (result.vertices != rough).mean() > 0.5
    assert ((across(coarse, result.vertices) * across(coarse, rough)).sum(axis=1) > 0).all()


@pytest.mark.kernels
def test_a_crease_goes_with_both_planes(made, device):
    mesh, moved, views = roof(made, device)
    ridge = (mesh.vertices[:, 0] == 0) & (abs(mesh.vertices[:, 1]) < mesh.vertices[:, 1].max() / 2)
    result = solve_mesh(mesh, views, device)
    apart = (result.vertices - mesh.vertices)[ridge] - moved
    assert ridge.sum() > 4 and np.linalg.norm(apart[:, [0, 2]], axis=1).max() < 0.1 * made.relief.footprint


@pytest.mark.kernels
def test_what_no_view_sees_stays_and_joins(made, coarse, device):
    """Half of the depth maps are gone: the other half goes where it goes, what is beyond a few edges stays bit for bit,
    to a hundredth of a footprint, and no edge between the two is longer than it must be."""
    views = []
    for view in observed(made):
        depth = view.depth.copy()
        depth[:, :80] = 0
        views.append(replace(view, depth=depth))
    result, pixel = solve_mesh(coarse, views, device), made.relief.footprint
    way = np.linalg.norm(result.vertices - coarse.vertices, axis=1) / pixel
    x = coarse.vertices[:, 0] / pixel
    assert way[x < -40].max() < 0.02 and way[(x > 25) & (result.seen >= 2)].mean() > 0.2
    a, b = coarse.faces[:, 0], coarse.faces[:, 1]
    assert np.percentile(abs(way[a] - way[b]), 99.9) < 2.5


@pytest.mark.kernels
def test_what_views_see_and_none_speaks_for_goes_with_its_surroundings(made, device):
    """A plane a footprint off, its middle of ten edges across without a depth that photos confirm."""
    pixel, steps = made.relief.footprint, np.arange(-30, 31)
    x, y = (1.5 * pixel * part.ravel() for part in np.meshgrid(steps, steps))
    plane = Surface(np.stack([x, y, 0 * x], axis=1), grid_faces(len(steps), len(steps)))
    lifted, out = plane.vertices - np.array([0, 0, pixel]), np.maximum(abs(x), abs(y)) / (1.5 * pixel)
    views = []
    for view, depth in zip(observed(made), each_depth(Surface(lifted, plane.faces), made.cameras[:5], device)):
        hole, (uv, _) = np.zeros(depth.shape, bool), view.camera.project(lifted[out < 5])
        (left, top), (right, bottom) = uv.min(axis=0).astype(int), uv.max(axis=0).astype(int)
        hole[top:bottom, left:right] = True
        views.append(Observed(view.camera, depth, np.where(hole, np.float32(np.inf), view.deviation)))
    way = (plane.vertices - solve_mesh(plane, views, device).vertices)[:, 2] / pixel
    assert 0.95 < way[(out > 8) & (out < 20)].mean() < 1.05 and way[out < 1].min() > 0.5


# -- against the twins ------------------------------------------------------------------------------------------------


@pytest.mark.kernels
@pytest.mark.parametrize("crease", [False, True])
def test_a_round_is_that_of_the_twin(made, device, crease):
    pytest.importorskip("scipy")
    mesh, _, views = roof(made, device) if crease else (Surface(*made.initial_mesh(8.0)), None, observed(made))
    normals, flatness = evidence_twin.vertex_normals(mesh.vertices, mesh.faces)
    reach = evidence_twin.mean_edges(mesh.vertices, mesh.faces)
    said = [evidence_twin.gather(mesh.vertices, normals, reach, view, drawn)
            for view, drawn in zip(views, each_depth(mesh, [view.camera for view in views], device))]
    target, weight, seen, sigma, unit = evidence_twin.resolve(*(np.array(part) for part in zip(*said)), 2)
    known = np.isfinite(unit)
    unit = np.where(known, unit, np.median(unit[known]))
    way = solve_twin.displacements(mesh.vertices, mesh.faces, normals, flatness, reach, unit, known, target, weight)
    result = solve_mesh(mesh, views, device, rounds=1)
    assert (flatness < solve_twin.SHARP).any() == crease
    same = result.seen == seen
    assert (seen >= 2).mean() > 0.3 and same.mean() > 0.99
    known = same & np.isfinite(sigma)
    assert np.abs(result.deviation[known] / sigma[known] - 1).max() < 1e-3
    # sixty steps of conjugate gradients against none
    apart = np.linalg.norm(result.vertices - mesh.vertices - way, axis=1)
    assert np.percentile(apart, 98) < 2e-3 * np.linalg.norm(way, axis=1).max() and result.held == 0


# -- subdividing ------------------------------------------------------------------------------------------------------


def test_subdivision_is_the_same_surface_without_cracks():
    rng = np.random.default_rng(1)
    vertices, faces = rng.normal(size=(4, 3)), np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    fine = subdivide(vertices, faces, np.array([0.3, 0.5, 0.2, 1.0]))
    new = fine.vertices(vertices)
    edges = np.sort(np.concatenate([fine.faces[:, [0, 1]], fine.faces[:, [1, 2]], fine.faces[:, [2, 0]]]), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()  # closed as before
    directed = np.concatenate([fine.faces[:, [0, 1]], fine.faces[:, [1, 2]], fine.faces[:, [2, 0]]])
    assert len(np.unique(directed, axis=0)) == len(directed)  # and orientated as before

    def area(v, f):
        return np.linalg.norm(np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]]), axis=1).sum()

    assert area(new, fine.faces) == pytest.approx(area(vertices, faces))
    assert (new[:4] == vertices).all()
    corners = fine.corners(vertices[faces])  # barycentric weights find the same places
    assert np.allclose(corners, new[fine.faces])
    assert fine.on_faces(np.arange(4)).shape == (len(fine.faces),)


def test_both_sides_of_a_seam_are_split_alike():
    """Vertices that are there twice had edges of their own, which were split by what is on their side alone."""
    y, x = (side.ravel() for side in np.mgrid[:6, :6])
    corner = np.flatnonzero((x < 5) & (y < 5))
    faces = np.concatenate([corner[:, None] + [0, 1, 7], corner[:, None] + [0, 7, 6]])
    sheet, right = np.stack([x, y, 0 * x], axis=1).astype(float), x[faces].mean(axis=1) > 3
    faces[right] += len(sheet)
    doubled = np.concatenate([sheet, sheet])
    fine = subdivide(doubled, faces, np.repeat([0.9, 0.3], len(sheet)))
    points, place = welded(fine.vertices(doubled))
    sides = np.sort(place[fine.faces][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    ends, count = np.unique(sides, axis=0, return_counts=True)
    middle = points[ends[count == 1]].mean(axis=1)
    assert count.max() == 2 and (np.isin(middle[:, :2], (0, 5)).any(axis=1)).all()
    assert len(np.unique(place[fine.faces[right[fine.parents]]])) > len(sheet)


def test_subdivision_is_bounded():
    with pytest.raises(InputError, match="more than 1000 vertices"):
        subdivide(np.eye(3), np.array([[0, 1, 2]]), np.full(3, 1e-3), most=1000)
    same = subdivide(np.eye(3), np.array([[0, 1, 2]]), np.full(3, np.inf))
    assert len(same.faces) == 1 and not same.rounds


@pytest.mark.filterwarnings("error")
def test_the_middle_of_what_is_infinite_or_unknown():
    """Deviations are infinite where nothing is known: whoever refines such a mesh again hears no warning of NumPy."""
    inf, nan = np.inf, np.nan
    ends = np.array([[1, 3], [inf, inf], [inf, 1], [1, inf], [-inf, -inf], [nan, 1], [inf, nan], [inf, -inf]])
    between = np.arange(len(ends))
    pairs = np.stack([between, len(ends) + between], axis=1)
    for dtype in (np.float64, np.float32):
        middles = with_middles(ends.T.reshape(-1).astype(dtype), pairs)[2 * len(ends):]
        assert np.array_equal(middles[:6], np.array([2, inf, inf, inf, -inf, nan], dtype), equal_nan=True)
    fine = subdivide(VERTICES, FACES, np.full(4, 0.4))
    known = Surface(VERTICES, FACES, attributes={"deviation": np.array([inf, inf, 1, nan])})
    carried = with_vertices(known, fine.vertices(VERTICES), fine).attributes["deviation"]
    assert len(carried) == len(fine.vertices(VERTICES)) and np.isinf(carried).sum() > 2


# -- what sits on the mesh --------------------------------------------------------------------------------------------

VERTICES = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])
UVS = np.array([[0, 0], [1, 0], [1, 1], [0.5, 0], [1, 0.5], [0, 1.0]])  # a seam along the diagonal
COLORS = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [51, 102, 153]]) / 255


@pytest.fixture(params=[False, True], ids=["same", "subdivided"])
def division(request):
    return subdivide(VERTICES, FACES, np.full(4, 0.8)) if request.param else None


def lifted(division, values):
    return values if division is None else division.vertices(values)


def expected_uvs(division):
    corners = UVS.reshape(2, 3, 2)
    return (corners if division is None else division.corners(corners)).reshape(-1, 2)


def test_open3d_legacy_keeps_all(division):
    o3d = pytest.importorskip("open3d")
    mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(VERTICES), o3d.utility.Vector3iVector(FACES))
    mesh.triangle_uvs = o3d.utility.Vector2dVector(UVS)
    mesh.triangle_material_ids = o3d.utility.IntVector([0, 1])
    mesh.vertex_colors = o3d.utility.Vector3dVector(COLORS)
    mesh.textures = [o3d.geometry.Image(np.zeros((2, 2, 3), np.uint8))]
    mesh.compute_vertex_normals()
    new = with_vertices(mesh, lifted(division, VERTICES) + [0, 0, 5], division)
    assert np.array_equal(np.asarray(new.triangle_uvs), expected_uvs(division))
    assert np.allclose(np.asarray(new.vertex_colors), lifted(division, COLORS))
    assert len(new.triangle_material_ids) == len(new.triangles) and len(new.textures) == 1
    assert np.allclose(np.asarray(new.vertex_normals), [0, 0, 1])
    assert np.asarray(mesh.vertices)[0, 2] == 0  # the given one is left alone


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_open3d_tensor_keeps_all(division, dtype):
    o3d = pytest.importorskip("open3d")
    o3c = o3d.core
    mesh = o3d.t.geometry.TriangleMesh()
    mesh.vertex["positions"] = o3c.Tensor(VERTICES.astype(dtype))
    mesh.triangle["indices"] = o3c.Tensor(FACES.astype(np.int64))
    mesh.triangle["texture_uvs"] = o3c.Tensor(UVS.reshape(2, 3, 2).astype(np.float32))
    mesh.vertex["colors"] = o3c.Tensor((COLORS * 255).astype(np.uint8))
    mesh.vertex["label"] = o3c.Tensor(np.arange(4)[:, None])
    mesh.triangle["part"] = o3c.Tensor(np.array([[7], [8]]))
    mesh.material.material_name = "defaultLit"
    mesh.material.texture_maps["albedo"] = o3d.t.geometry.Image(o3c.Tensor(np.zeros((2, 2, 3), np.uint8)))
    quality = np.linspace(0, 1, len(lifted(division, VERTICES)))
    new = with_vertices(mesh, lifted(division, VERTICES) + [0, 0, 5], division, quality)
    assert new.vertex["positions"].numpy().dtype == dtype
    assert np.allclose(new.triangle["texture_uvs"].numpy().reshape(-1, 2), expected_uvs(division))
    count = len(new.triangle["indices"])
    assert set(new.triangle["part"].numpy().ravel()) == {7, 8} and len(new.triangle["part"]) == count
    assert len(new.vertex["label"]) == len(quality) and new.vertex["colors"].numpy().dtype == np.uint8
    mean = lifted(division, (COLORS * 255).astype(np.uint8).astype(float))      # in 8 bits, too; not that of one end
    assert np.abs(new.vertex["colors"].numpy() - mean).max() <= 0.5
    assert np.allclose(new.vertex["quality"].numpy().ravel(), quality)
    assert new.material.material_name == "defaultLit" and list(new.material.texture_maps) == ["albedo"]


def test_open3d_normals_and_neighbours_fit_and_nothing_is_printed(division, capfd):
    o3d = pytest.importorskip("open3d")
    mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(VERTICES), o3d.utility.Vector3iVector(FACES))
    mesh.compute_adjacency_list()
    new = with_vertices(mesh, lifted(division, VERTICES) + [0, 0, 5], division)
    assert len(new.adjacency_list) == len(new.vertices)
    new = with_vertices(o3d.t.geometry.TriangleMesh.from_legacy(mesh.compute_vertex_normals()),
                        lifted(division, VERTICES) + [0, 0, 5], division)
    assert np.allclose(new.vertex["normals"].numpy(), [0, 0, 1]) and len(new.vertex["normals"]) == len(new.vertex[
        "positions"])
    assert np.allclose(new.triangle["normals"].numpy(), [0, 0, 1])
    assert "WARNING" not in "".join(capfd.readouterr())


def test_pymeshlab_keeps_texture_coordinates_and_colours(division):
    pymeshlab = pytest.importorskip("pymeshlab")
    mesh = pymeshlab.Mesh(VERTICES, FACES, w_tex_coords_matrix=UVS, f_scalar_array=np.array([3.0, 4]),
                          v_color_matrix=np.column_stack([COLORS, np.ones(4)]))
    quality = np.linspace(0, 1, len(lifted(division, VERTICES)))
    new = with_vertices(mesh, lifted(division, VERTICES) + [0, 0, 5], division, quality)
    assert np.allclose(new.wedge_tex_coord_matrix(), expected_uvs(division), atol=1e-7)
    assert np.abs(new.vertex_color_matrix()[:4, :3] - COLORS).max() < 1e-12
    assert np.array_equal(new.vertex_scalar_array(), quality) and set(new.face_scalar_array()) == {3.0, 4.0}


def test_pair_surface_and_file(division, tmp_path):
    new = lifted(division, VERTICES) + 1.0
    vertices, faces = with_vertices((VERTICES, FACES), new, division)
    assert np.array_equal(vertices, new) and faces.max() < len(new)
    surface = with_vertices(Surface(VERTICES, FACES, colors=COLORS), new, division)
    assert len(surface.colors) == len(new)
    texture = Texture(UVS.reshape(2, 3, 2), np.array([0, 1], np.int32), (Material("a"), Material("b")))
    textured = with_vertices(Surface(VERTICES, FACES, texture=texture), new, division)
    assert np.array_equal(textured.texture.coordinates.reshape(-1, 2), expected_uvs(division))
    assert len(textured.texture.materials) == len(textured.faces) and set(textured.texture.materials) == {0, 1}
    write_mesh(tmp_path / "m.obj", textured)
    read = read_mesh(tmp_path / "m.obj")
    assert np.array_equal(read.texture.coordinates, textured.texture.coordinates)
    assert np.array_equal(read.texture.materials, textured.texture.materials)


# -- with the engine --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("subdivide", [None, 2.0])
def test_refine_mesh_keeps_the_mesh(made, subdivide):
    o3d = pytest.importorskip("open3d")
    import pagas_cl

    vertices, faces = made.initial_mesh(4.0)
    mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(faces))
    mesh.triangle_uvs = o3d.utility.Vector2dVector(np.tile([[0, 0], [1, 0], [0, 1.0]], (len(faces), 1)))
    result = pagas_cl.refine_mesh(mesh, made.cameras[:5], [v.image for v in made.views], preset="fast",
                                  output="displace", subdivide=subdivide)
    new, split = np.asarray(result.vertices), np.asarray(result.triangles)
    assert len(result.triangle_uvs) == 3 * len(split)
    assert np.array_equal(split, faces) if subdivide is None else len(split) > 2 * len(faces)
    before = height_error(made, vertices[faces].mean(axis=1)).mean()
    after = height_error(made, new[split].mean(axis=1)).mean()
    assert after < (0.8 if subdivide is None else 0.6) * before


@pytest.mark.filterwarnings("ignore:nothing was refined")
@pytest.mark.parametrize("edge", [2.0, 8.0, 30.0])
@pytest.mark.parametrize("number", [1, 3])
def test_where_nothing_moved_the_mesh_comes_back_as_it_was(edge, number, device):
    """One view, or photos of one colour: no triangle is split, and quality stays what it was."""
    import pagas_cl

    scene = relief_scene(96, 72, contexts=3, held_out=0)
    vertices, faces = scene.initial_mesh(edge)
    colors, quality = (np.random.default_rng(2).uniform(size=(len(vertices), *size)) for size in ((3,), ()))
    photos = [view.load_image() if number == 1 else np.full_like(view.load_image(), 90) for view in scene.views]
    config = pagas_cl.preset("fast").with_settings(pyramid__steps=(5,), effects__cameras="off")
    for output in ("mesh", "displace"):
        same = pagas_cl.refine_mesh(Surface(vertices, faces, None, colors, quality), scene.cameras[:number],
                                    photos[:number], config=config, device=device, output=output)
        assert np.array_equal(same.vertices, vertices) and np.array_equal(same.faces, faces)
        assert np.array_equal(same.colors, colors) and np.array_equal(same.quality, quality)
        assert np.isinf(same.attributes["deviation"]).all() and same.attributes["views"].max() < 2


def test_a_mesh_that_was_refined_is_refined_again(device, tmp_path, recwarn):
    """From the file that was written: whatever sits on it is carried along, without a warning."""
    import pagas_cl

    scene = relief_scene(96, 72, contexts=3, held_out=0)
    photos = [view.load_image() for view in scene.views]
    config = pagas_cl.preset("fast").with_settings(pyramid__steps=(5,), effects__cameras="off")
    mesh = Surface(*scene.initial_mesh(8.0))
    for output, longest in (("mesh", None), ("displace", 2.0), ("mesh", None)):
        mesh = pagas_cl.refine_mesh(mesh, scene.cameras, photos, config=config, device=device, output=output,
                                    subdivide=longest)
        write_mesh(tmp_path / "refined.ply", mesh)
        mesh = tmp_path / "refined.ply"
    assert np.isinf(read_mesh(mesh).attributes["deviation"]).any()
    assert not [warning for warning in recwarn if issubclass(warning.category, RuntimeWarning)]


@pytest.mark.parametrize("faces, share", [
    (lambda faces: faces, 0), (lambda faces: faces[:, ::-1], 0), (lambda faces: np.concatenate([faces] * 2), 0),
    (lambda faces: np.concatenate([faces, faces[:, ::-1]]), 100),
    (lambda faces: np.concatenate([faces[::2], faces[1::2, ::-1]]), 94)])
def test_triangles_that_face_opposite_sides_are_named(faces, share, made, device, caplog):
    """Where normals cancel no vertex moves, and neither cameras nor photos are to blame."""
    import pagas_cl

    vertices, plain = made.initial_mesh(8.0)
    photos, config = [view.load_image() for view in made.views], pagas_cl.preset("fast")
    found = pagas_cl.refine_mesh((vertices, np.ascontiguousarray(faces(plain))), made.cameras[:5], photos,
                                 device=device, output="displace", config=config.with_settings(pyramid__steps=(5,)))
    assert (f"opposite sides around {share} % of its vertices" in caplog.text) == (share > 0)
    assert share or (found[0] != vertices).any()


def test_wrong_settings():
    import pagas_cl

    with pytest.raises(InputError, match="expected 'mesh', 'tsdf' or 'displace'"):
        pagas_cl.refine_mesh((VERTICES, FACES), [], [], output="other")
    with pytest.raises(InputError, match="tolerance is -1"):
        pagas_cl.refine_mesh((VERTICES, FACES), [], [], tolerance=-1)
    with pytest.raises(InputError, match="triangles is 0.5"):
        pagas_cl.refine_mesh((VERTICES, FACES), [], [], triangles=0.5)
    with pytest.raises(InputError, match="got both"):
        pagas_cl.refine_mesh((VERTICES, FACES), [], [], triangles=10, tolerance=1)
    with pytest.raises(InputError, match="triangles is for output='mesh'"):
        pagas_cl.refine_mesh((VERTICES, FACES), [], [], output="tsdf", triangles=10)
    with pytest.raises(InputError, match="pixel footprints"):
        pagas_cl.refine_mesh((VERTICES, FACES), [], [], output="displace", subdivide=0)
    with pytest.raises(InputError, match="subdivide is for output='mesh' or 'displace'.* set fusion.voxel"):
        pagas_cl.refine_mesh((VERTICES, FACES), [], [], output="tsdf", subdivide=2.0)
    for memory in (0, float("inf")):        # int() of infinity: a traceback after the work
        with pytest.raises(InputError, match=f"memory is {memory}, expected None or MB of host memory, above 0, at"):
            pagas_cl.refine_mesh((VERTICES, FACES), [], [], memory=memory)


def test_memory_limits_the_triangles_and_says_so(device, caplog):
    import pagas_cl

    scene = relief_scene(96, 72, contexts=3, held_out=0)
    photos, mesh = [view.load_image() for view in scene.views], Surface(*scene.initial_mesh(8.0))
    config = pagas_cl.preset("fast").with_settings(pyramid__steps=(20,), effects__cameras="off")
    free, held = (pagas_cl.refine_mesh(mesh, scene.cameras, photos, config=config, device=device, memory=memory)
                  for memory in (None, 450e-6 * 1.2 * len(mesh.faces)))
    assert len(held.faces) <= 1.2 * len(mesh.faces) < len(free.faces)
    assert "or memory of refine_mesh" in caplog.text


def test_mesh_to_mesh_needs_no_open3d(device, monkeypatch, tmp_path):
    import sys

    from pagas_cl import preset, refine_mesh

    for name in ("open3d", "scipy"):
        monkeypatch.setitem(sys.modules, name, None)
    scene = relief_scene(64, 48, contexts=4, held_out=0)
    photos = [view.load_image() for view in scene.views]
    for cameras in ("auto", "on"):
        config = preset("fast").with_settings(pyramid__steps=(5,), effects__cameras=cameras)
        heard = []
        vertices, faces = refine_mesh(scene.initial_mesh(), scene.cameras, photos, config=config, device=device,
                                      output="mesh", progress=lambda *given: heard.append(given))[:2]
        solving = [done / total for stage, done, total in heard if stage == "solve the mesh"]
        assert solving[0] == 0 and solving[-1] == 1 and len(solving) > 3 and (np.diff(solving) > 0).all()
        assert len(vertices) and len(faces) and np.isfinite(vertices).all()
    vertices, faces = scene.initial_mesh()
    write_mesh(tmp_path / "coarse.ply", Surface(vertices, faces, attributes={"part": np.arange(len(vertices))}))
    fine = refine_mesh(tmp_path / "coarse.ply", scene.cameras, photos, config=config, device=device, output="displace")
    write_mesh(tmp_path / "fine.ply", fine)
    assert set(read_mesh(tmp_path / "fine.ply").attributes) == {"part", "deviation", "views"}


def test_progress_follows_the_triangles(made, device, monkeypatch):
    """Less is done when the last level begins, the more triangles it has compared with those of the levels before."""
    monkeypatch.setattr(mesh_levels, "_SURE", (1e-9,) * 3)      # many triangles, as if views were sure of all
    views, begun = observed(made), []
    for step, most in ((8.0, 12_000), (2.0, 30_000), (8.0, 100_000)):     # one level of few, of many; all three
        coarse, heard = Surface(*made.initial_mesh(step)), []
        size = footprints(coarse.vertices, [v.camera for v in views], [v.depth for v in views])
        component = component_of(welded(coarse.vertices)[1], coarse.faces)
        fit_mesh(coarse, views, device, size, component, tolerance=0.03, most=most, at=heard.append)
        assert heard[0] == 0 and heard == sorted(heard)
        begun.append(heard[-1])
    short, long, whole = begun
    assert 0.2 < short < 0.75 * long and 0.33 < long < 0.38 and 1.15 * short < whole < 0.9 * long


@pytest.mark.kernels
def test_no_triangles_where_depth_maps_are_not_that_sure(made, device):
    """Deviations of a tenth of a pixel of parallax: fewer are needed than to the tolerance of sure depth maps."""
    coarse = Surface(*made.initial_mesh(4.0))
    views = observed(made)
    size = footprints(coarse.vertices, [v.camera for v in views], [v.depth for v in views])
    component = component_of(welded(coarse.vertices)[1], coarse.faces)
    division, solved, place, _ = fit_mesh(coarse, views, device, size, component, most=100_000)
    found = mesh_levels.tolerance_of(None, division.faces, solved)
    assert 2 * mesh_levels.TOLERANCE < found < 0.15
    sure, unsure = (len(simplified(device, division, solved.vertices, solved.unit, place, np.zeros(len(place), bool),
                                   exact=False, tolerance=tolerance)[0].faces)
                    for tolerance in (mesh_levels.TOLERANCE, found))
    assert unsure < 0.8 * sure


@pytest.mark.kernels
@pytest.mark.parametrize("most", [100_000, 12_000])
def test_triangles_go_where_the_detail_is(made, device, most, monkeypatch):
    """Coarse to fine: no more triangles than there is memory for, nearer to the truth than the mesh split everywhere;
    two halves that share no vertex, as at a texture seam, stay together."""
    monkeypatch.setattr(mesh_levels, "_SURE", (1e-9,) * 3)      # many triangles, as if views were sure of all
    views, coarse = observed(made), Surface(*made.initial_mesh(8.0))
    upper = coarse.vertices[coarse.faces, 1].mean(axis=1) > 0
    half, rest = coarse.faces[~upper], coarse.faces[upper]
    count = len(coarse.vertices)
    doubled = Surface(np.concatenate([coarse.vertices] * 2), np.concatenate([half, rest + count]))
    size = footprints(doubled.vertices, [v.camera for v in views], [v.depth for v in views])
    component = component_of(welded(doubled.vertices)[1], doubled.faces)
    division, solved, place, _ = fit_mesh(doubled, views, device, size, component, most=most)
    assert len(division.faces) <= most
    needed, vertices = simplified(device, division, solved.vertices, solved.unit, place, np.zeros(len(place), bool),
                                  exact=False, tolerance=0.05)
    assert len(needed.faces) < 0.7 * len(division.faces)
    error = height_error(made, vertices[needed.faces].mean(axis=1)).mean()
    given = height_error(made, coarse.vertices[coarse.faces].mean(axis=1)).mean()
    assert error < (0.2 if most > 50_000 else 0.35) * given
    points, where = np.unique(vertices, axis=0, return_inverse=True)      # closed but for its border: no crack
    faces = where.reshape(-1)[needed.faces]
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    found, times = np.unique(edges, axis=0, return_counts=True)
    border = np.abs(points[found[times == 1]][:, :, :2]) / np.abs(coarse.vertices[:, :2]).max(axis=0)
    assert (border.max(axis=2) > 0.999).all() and times.max() == 2
