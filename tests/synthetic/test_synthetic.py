"""Synthetic scenes: what they call exact is exact, and equal descriptions give equal bytes."""

import numpy as np
import pytest
from support.scenes import mixed_scene, plane, small, tiny
from support.synthetic import relief_scene
from support.synthetic.photo import depth_and_part
from support.synthetic.solid import BAR, BLOCK, MISS, RELIEF, Bar, Block, Solid
from support.synthetic.texture import Texture, noise
from support.synthetic.waves import Waves

from pagas_cl.app.evaluate.depth import compare_depth, depth_per_parallax, dilate, find_discontinuities
from pagas_cl.errors import InputError
from pagas_cl.scene.depthmap import central_normals as depth_normals

pytestmark = pytest.mark.slow


def discontinuities(made):
    return find_discontinuities(made.true_depth(made.cameras[0]), made.cameras[0])


def world_points(camera, depth):
    points = depth[..., None] * camera.rays()
    return points @ camera.world_to_camera[:3, :3] + camera.center


def test_slopes_are_derivatives():
    rng = np.random.default_rng(1)
    field = Waves.random(rng, 7, 2.0, 30.0, 1.0, envelope=Waves.random(rng, 3, 40.0, 90.0, 0.0).scaled(0.3))
    x, y = rng.uniform(-50, 50, (2, 200))
    step = 1e-5
    _, slope_x, slope_y = field(x, y)
    assert np.allclose((field(x + step, y)[0] - field(x - step, y)[0]) / (2 * step), slope_x, atol=1e-7)
    assert np.allclose((field(x, y + step)[0] - field(x, y - step)[0]) / (2 * step), slope_y, atol=1e-7)
    for exact, quick in zip(field(x, y), field(x, y, precise=False)):
        assert np.abs(exact - quick).max() < 2e-5


@pytest.mark.parametrize("view", [0, 1, 3])
def test_depth_lies_on_the_surface(view):
    made = tiny(bar=6.0, steps=4)
    camera, solid = made.cameras[view], made.true_solid
    depth, part = depth_and_part(solid, camera)
    points = world_points(camera, depth)
    height = solid.height(points[..., 0], points[..., 1])[0]
    assert set(np.unique(part)) >= {RELIEF, BAR, BLOCK}
    on = part == RELIEF
    assert np.abs(points[..., 2] - height)[on].max() < 1e-6
    for k, block in enumerate(solid.blocks):
        top = part == BLOCK + 2 * k
        assert np.abs(points[..., 2] - height + block.rise)[top].max() < 1e-6
        u, v = block.frame(points[part == BLOCK + 2 * k + 1][:, :2])
        off = np.minimum(np.abs(np.abs(u) - block.half_width), np.abs(np.abs(v) - block.half_height))
        assert off.size == 0 or off.max() < 1e-6
    arm = points[part == BAR] - solid.bar.point
    axis = np.asarray(solid.bar.direction)
    across = np.linalg.norm(arm - (arm @ axis)[:, None] * axis, axis=1)
    assert np.abs(across - solid.bar.radius).max() < 1e-6


def test_first_surface_is_found():
    """Steep waves seen at a slant hide one another: no point in front of the found one may be inside."""
    rng = np.random.default_rng(3)
    waves = Waves.random(rng, 5, 6.0, 20.0, 1.0).scaled(1.5)
    amplitude = np.abs(waves.amplitude)
    steepest = 2 * np.pi * (amplitude * np.linalg.norm(waves.frequencies, axis=1)).sum()
    solid = Solid((waves,), (amplitude.sum(), steepest), (Block(2.0, 1.0, 6.0, 4.0, 5.0, 0.4),),
                  Bar((0.0, 0.0, -12.0), (0.0, 1.0, 0.0), 0.5))
    origin = np.array([60.0, 10.0, -60.0])
    ends = np.stack([*rng.uniform(-25, 25, (2, 400)), np.zeros(400)], axis=-1)
    ray = ends - origin
    depth, part = solid.meet(origin, ray)
    assert (part != MISS).all()
    share = np.linspace(0.5, 1, 4000)[:-1]
    for d, r in zip(depth, ray):
        p = origin + (share * d)[:, None] * r
        height = solid.height(p[:, 0], p[:, 1])[0]
        u, v = solid.blocks[0].frame(p[:, :2])
        raised = (np.abs(u) < 6.0) & (np.abs(v) < 4.0)
        assert (p[:, 2] < height - 5.0 * raised + 1e-6).all()
        assert (np.hypot(p[:, 0], p[:, 2] + 12.0) > 0.5 - 1e-6).all()


def test_normals_agree_with_the_depth_map():
    made = small()
    camera = made.cameras[0]
    given, measured = made.true_normals(camera), depth_normals(made.true_depth(camera), camera)
    assert np.allclose((given**2).sum(-1), 1, atol=1e-5)
    assert ((given * camera.rays()).sum(-1) < 0).mean() > 0.999
    angle = np.degrees(np.arccos(np.clip((given * measured).sum(-1), -1, 1)))
    away = ~dilate(discontinuities(made), 2)
    assert np.nanmedian(angle[away]) < 1.0  # central differences see detail of 5 px a little too smooth


def test_photos_agree_through_the_true_depth():
    """Warping through the true depth predicts the other photos better than through the initial one."""
    from pagas_cl.method.view.prediction import compare_predictions

    made = small(contexts=1)      # photos are made of all views
    camera = made.cameras[0]
    depths = [made.true_depth(camera), made.initial_depth(camera)]
    for other in (made.views[1], made.held_out[0]):
        true, initial = compare_predictions(made.views[0], depths, other)
        assert true.median > 0.985 and true.median > initial.median + 0.005


def test_the_initial_error_is_the_one_requested():
    made = small()
    camera = made.cameras[0]
    report = compare_depth(made.initial_depth(camera), made.true_depth(camera), camera,
                           parallax=made.relief.parallax, true_normals=made.true_normals(camera))
    assert 0.22 < report.smooth.mean_parallax < 0.28
    assert 10 < report.smooth.normal_mean < 20
    assert report.edges.pixels < 0.1 * report.all.pixels
    one_pixel = depth_per_parallax(made.true_depth(camera), camera, made.cameras[1:6])
    assert 0.6 < np.median(one_pixel) / made.relief.parallax < 1.2


def test_equal_descriptions_give_equal_bytes_whatever_the_blocks(monkeypatch):
    first = relief_scene(64, 48, contexts=1, held_out=0, noise=3.0, exposure=0.2, foreground=True, bar=4.0)
    second = relief_scene(64, 48, contexts=1, held_out=0, noise=3.0, exposure=0.2, foreground=True, bar=4.0)
    photos = [view.load_image() for view in first.views]
    monkeypatch.setattr("support.synthetic.photo._ROWS", 64 * 7)
    for photo, again in zip(photos, second.views):
        assert np.array_equal(photo, again.load_image())
    assert (relief_scene(64, 48, contexts=1, held_out=0, seed=1).image(0) != photos[0]).any()


def test_photos_are_pixel_integrals(monkeypatch):
    """Photos of a plane at a third of the resolution are the averages of 3 x 3 pixels of the full one."""
    fine, coarse = plane(texture="noise"), None
    camera = fine.cameras[0]
    from support.synthetic import photo

    coarse = photo.photograph(fine.true_solid, fine.skin, camera.resized(32, 24))
    monkeypatch.setattr(photo, "_SAMPLES", 1)
    full = photo.photograph(fine.true_solid, fine.skin, camera).astype(float)
    average = full.reshape(24, 3, 32, 3, 3).mean((1, 3))
    assert np.abs(average - coarse).max() <= 1.5


def test_foreground_comes_with_masks_and_exposure_with_gains():
    made = tiny(foreground=True)
    view = made.views[1]
    assert np.array_equal(view.load_mask(), made.true_depth(view.camera) > 0)
    assert 0.3 < view.load_mask().mean() < 0.6
    plain, jittered = tiny(), tiny(exposure=0.3)
    assert np.array_equal(plain.image(0), jittered.image(0))
    assert np.abs(plain.image(1).astype(int) - jittered.image(1)).mean() > 2


def test_mixed_views():
    made = mixed_scene(96, 72, contexts=4, sizes=(0.5, 1.0), zooms=(1.0, 0.8), distances=(1.3,), texture="noise")
    sizes = [(v.width, v.height) for v in made.cameras[1:5]]
    assert sizes == [(48, 36), (96, 72)] * 2
    away = [np.linalg.norm(v.center) for v in made.cameras]
    assert np.allclose(away[:2], [650, 845])
    assert made.all_views[1].load_image().shape == (36, 48, 3)


def test_initial_mesh_matches_the_initial_depth():
    made = tiny(bar=6.0)
    vertices, faces = made.initial_mesh()
    assert faces.min() == 0 and faces.max() == len(vertices) - 1
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    assert (area > 0).all()
    camera = made.cameras[0]
    uv, z = camera.project(vertices)
    inside = (uv > 1).all(1) & (uv[:, 0] < camera.width - 1) & (uv[:, 1] < camera.height - 1)
    depth = made.initial_depth(camera)
    column, row = uv[inside].astype(int).T
    # a vertex lies on the seen surface or behind it (walls, what the bar and the blocks hide)
    gap = z[inside] - depth[row, column]
    assert np.median(np.abs(gap)) < 0.5 * made.relief.footprint and (gap > -40).all()


def test_textures():
    texels = np.arange(12, dtype=np.float32).reshape(2, 2, 3)
    texture = Texture(texels, 2.0)
    assert np.allclose(texture(np.array([-1.0, 1.0]), np.array([-1.0, -1.0])), texels[0])
    assert np.allclose(texture(np.array([3.0]), np.array([-1.0])), texels[:1, 1])  # mirrored
    assert np.allclose(texture(np.zeros(1), np.zeros(1)), texels.mean((0, 1)))
    speckle = noise(40, 30, np.random.default_rng(0))
    assert speckle.shape == (30, 40, 3) and 0 <= speckle.min() and speckle.max() <= 1 and speckle.std() > 0.1


def test_without_scikit_image_noise_takes_over(monkeypatch, caplog):
    monkeypatch.setattr("support.synthetic.texture.find_spec", lambda name: None)
    made = relief_scene(48, 36, contexts=1, held_out=0)
    assert "scikit-image" in caplog.text
    assert made.image(0).std() > 10


@pytest.mark.parametrize("settings, said", [({"width": 4}, "width is 4"), ({"contexts": 99}, "contexts is 99"),
                                            ({"texture": "wood"}, "'wood'"), ({"colour": 1}, "'colour'")])
def test_bad_settings(settings, said):
    with pytest.raises(InputError, match=said):
        relief_scene(**{"width": 48, "height": 36, **settings})
