"""The step for Open3D's RGB-D pipelines: every form of frames, the tutorial's loop, and half pixels."""

import numpy as np
import pytest
from conftest import look_at, plane_depth
from PIL import Image

o3d = pytest.importorskip("open3d")

from support.scenes import relief_scene  # noqa: E402

from pagas_cl.config.presets import BALANCED  # noqa: E402
from pagas_cl.errors import InputError  # noqa: E402
from pagas_cl.filters.open3d_pipeline import grid_intrinsic, refine_and_integrate, refine_rgbd  # noqa: E402

pytestmark = pytest.mark.slow

FEW = BALANCED.with_settings(pyramid__scales=(1.0,), pyramid__steps=(10,), fusion__voxel=2.0)
o3c = o3d.core


@pytest.fixture(scope="module")
def made():
    return relief_scene(64, 48, contexts=2, held_out=0, steps=0)


def intrinsic(camera):
    """As Open3D's legacy cameras have it: pixel centres at whole numbers."""
    return o3d.camera.PinholeCameraIntrinsic(camera.width, camera.height, camera.fx, camera.fy, camera.cx - 0.5,
                                             camera.cy - 0.5)


def parts(made):
    """Colour (uint8) and depth (float32) of each view, and what Open3D calls intrinsic and extrinsics."""
    cameras = made.cameras[:3]
    colors = [np.ascontiguousarray(view.image) for view in made.views]
    depths = [made.initial_depth(camera) for camera in cameras]
    return colors, depths, intrinsic(cameras[0]), [camera.world_to_camera for camera in cameras]


def parameters_of(intrinsic, extrinsic):
    made = o3d.camera.PinholeCameraParameters()
    made.intrinsic, made.extrinsic = intrinsic, extrinsic
    return made


def legacy(color, depth, scale=1.0):
    return o3d.geometry.RGBDImage.create_from_color_and_depth(
        o3d.geometry.Image(color), o3d.geometry.Image(depth), depth_scale=scale, depth_trunc=1e9,
        convert_rgb_to_intensity=False)


def tensor(color, depth):
    image = o3d.t.geometry.Image
    return o3d.t.geometry.RGBDImage(image(o3c.Tensor(color)), image(o3c.Tensor(depth[..., None])))


@pytest.fixture(scope="module")
def expected(made):
    """What refine_depth gives."""
    from pagas_cl.refine import refine_views

    depths = parts(made)[1]
    return [result.depth for result in refine_views(made.views, depths, config=FEW)]


def test_every_form_gives_the_same_and_comes_back_unchanged(made, expected, tmp_path):
    colors, depths, K, E = parts(made)
    paths = []
    for k, color in enumerate(colors):
        Image.fromarray(color).save(tmp_path / f"{k}.png")
        paths.append(tmp_path / f"{k}.png")
    forms = {
        "legacy": [legacy(c, d) for c, d in zip(colors, depths)],
        "tensor": [tensor(c, d) for c, d in zip(colors, depths)],
        "images": [(o3d.geometry.Image(c), o3d.geometry.Image(d)) for c, d in zip(colors, depths)],
        "tensor images": [(tensor(c, d).color, tensor(c, d).depth) for c, d in zip(colors, depths)],
        "arrays": list(zip(colors, depths)),
        "Pillow": [(Image.fromarray(c), Image.fromarray(d)) for c, d in zip(colors, depths)],
        "paths": list(zip(paths, depths)),
    }
    for name, frames in forms.items():
        for frame, got, want in zip(frames, refine_rgbd(frames, K, E, config=FEW), expected):
            assert type(got) is type(frame)
            depth = got[1] if isinstance(got, tuple) else got.depth
            if isinstance(frame, tuple):
                assert type(depth) is type(frame[1]), name
            depth = depth.as_tensor().numpy()[..., 0] if hasattr(depth, "as_tensor") else np.asarray(depth)
            assert depth.dtype == np.float32 and np.array_equal(depth, want), name


def test_cameras_in_every_form(made, expected):
    colors, depths, K, E = parts(made)
    frames = list(zip(colors, depths))
    trajectory = o3d.camera.PinholeCameraTrajectory()
    parameters = [parameters_of(K, extrinsic) for extrinsic in E]
    trajectory.parameters = parameters
    corner = made.cameras[0].K  # COLMAP's
    for given, kwargs in (((trajectory,), {}), ((parameters,), {}), (([K] * 3, E), {}),
                          ((corner, E), {"pixel_center": 0.5}),
                          ((o3c.Tensor(corner), [o3c.Tensor(e) for e in E]), {"pixel_center": 0.5})):
        got = refine_rgbd(frames, *given, config=FEW, **kwargs)
        assert max(np.abs(g[1] - w).max() for g, w in zip(got, expected)) < 1e-2 * made.relief.parallax


def test_images_of_pillow_mean_what_they_show(made):
    """A palette is no colour, and what Pillow opens as 32-bit numbers is a 16-bit depth."""
    colors, depths, K, E = parts(made)
    arrays = [(np.asarray(Image.fromarray(c).quantize(64).convert("RGB")), np.rint(d * 50).astype(np.uint16))
              for c, d in zip(colors, depths)]
    pillow = [(Image.fromarray(c).quantize(64), Image.fromarray(d.astype(np.int32)))
              for c, (_, d) in zip(colors, arrays)]
    for (_, want), (_, got) in zip(refine_rgbd(arrays, K, E, depth_scale=50, config=FEW),
                                   refine_rgbd(pillow, K, E, depth_scale=50, config=FEW)):
        assert isinstance(got, Image.Image) and np.array_equal(np.asarray(got), want)


def test_sixteen_bit_depth_with_scale_and_trunc(made):
    """In Open3D's meaning: numbers are divided by the scale, what reaches depth_trunc is dropped."""
    colors, depths, K, E = parts(made)
    depths16 = [np.rint(d * 50).astype(np.uint16) for d in depths]
    far = float(np.median(depths[0]))
    frames = list(zip(colors, depths16))
    got = refine_rgbd(frames, K, E, depth_scale=50.0, depth_trunc=far, config=FEW)
    same = [legacy(c, d, 50.0) for c, d in zip(colors, depths16)]
    for (_, new), raw, open3d_frame in zip(got, depths16, same):
        valid = (raw > 0) & (raw / 50 < far)
        assert new.dtype == np.float32 and np.array_equal(new > 0, valid)
        units = new[valid] / 50
        assert np.abs(units - np.asarray(open3d_frame.depth)[valid]).max() < 9 * made.relief.parallax
    with pytest.raises(InputError, match="already holds scene units"):
        refine_rgbd(same, K, E, depth_scale=50.0, config=FEW)


@pytest.mark.parametrize("dtype", [">u2", np.int32, np.int64])
def test_whole_numbers_are_thousandths(made, dtype):
    colors, depths, K, E = parts(made)
    numbers = [np.rint(100 * depth).astype(np.uint16) for depth in depths]      # of a scene a tenth as large
    E = [np.block([[pose[:3, :3], pose[:3, 3:] / 10], [pose[3:]]]) for pose in E]
    first, second = (refine_rgbd(list(zip(colors, given)), K, E, config=FEW)
                     for given in (numbers, [depth.astype(dtype) for depth in numbers]))
    assert all(np.array_equal(a, b) for (_, a), (_, b) in zip(first, second))


def test_a_voxel_size_of_another_unit_is_refused(made):
    colors, depths, K, E = parts(made)
    with pytest.raises(InputError, match="voxel_size is 1e\\+06 scene units, .*the unit of the cameras"):
        refine_and_integrate(list(zip(colors, depths)), K, E, config=FEW, voxel_size=1e6)


def test_the_grids_intrinsic_of_any_kind(made):
    K = intrinsic(made.cameras[0])
    for given in (K.intrinsic_matrix, o3c.Tensor(K.intrinsic_matrix)):
        assert np.array_equal(grid_intrinsic(given).numpy(), grid_intrinsic(K).numpy())
    for wrong, center, sentence in ((None, 0, "K is an array of object, expected"), (K, None, "pixel_center is None"),
                                    (K, np.nan, "pixel_center is nan"), (np.eye(4), 0, r"has shape \(4, 4\)")):
        with pytest.raises(InputError, match=sentence):
            grid_intrinsic(wrong, pixel_center=center)


def test_one_call_gives_a_mesh_that_lies_right(made):
    colors, depths, K, E = parts(made)
    frames = [legacy(c, d) for c, d in zip(colors, depths)]
    mesh = refine_and_integrate(frames, K, E, config=FEW)
    assert isinstance(mesh, o3d.t.geometry.TriangleMesh)
    vertices = mesh.vertex["positions"].numpy()
    assert len(vertices) > 300 and {"colors", "normals", "quality"} <= set(mesh.vertex)
    x, y, z = vertices[(np.abs(vertices[:, 0]) < 90) & (np.abs(vertices[:, 1]) < 60)].T
    height = made.true_solid.height(x, y)[0]
    assert min(np.abs(z - height).mean(), np.abs(z + height).mean()) < 0.5 * made.relief.parallax
    finer = refine_and_integrate(frames, K, E, voxel_size=1.3 * made.relief.footprint, config=FEW)
    ratio = len(finer.vertex["positions"]) / len(vertices)
    assert 1.6 < ratio < 3.4  # edges of 1.3 instead of 2 footprints


def test_frames_that_could_not_be_refined_are_integrated_unchanged(made, monkeypatch):
    from pagas_cl.filters import open3d_pipeline
    from pagas_cl.result import DepthResult

    monkeypatch.setattr(open3d_pipeline, "refine_views", lambda views, *_, **__: [
        DepthResult.missing(view.camera, "its photo has gone", view.name) for view in views])
    colors, depths, K, E = parts(made)
    mesh = refine_and_integrate([legacy(c, d) for c, d in zip(colors, depths)], K, E, config=FEW)
    assert len(mesh.vertex["positions"]) > 300


@pytest.mark.parametrize("change, sentence", [
    (lambda f, K, E: ([], K, E), "no frames"),
    (lambda f, K, E: (f, K, E[:2]), "2 extrinsics were given for 3 frames"),
    (lambda f, K, E: (f, [K], E), "1 intrinsics were given"),
    (lambda f, K, E: (f, K, None), "extrinsics are missing"),
    (lambda f, K, E: (f, "trajectory.json"), "intrinsics is a str: .*read_pinhole_camera_trajectory reads one"),
    (lambda f, K, E: ([(c, d[:-1]) for c, d in f], K, E), "color is 64 x 48 and depth 64 x 47"),
    (lambda f, K, E: ([(c[:, :-2], d) for c, d in f], K, E), "register the depth"),
    (lambda f, K, E: ([(c, d * 0) for c, d in f], K, E), "none of the 3 frames has a valid depth"),
    (lambda f, K, E: ([c for c, d in f], K, E), "expected an Open3D RGBDImage"),
    (lambda f, K, E: ([(c, d, d) for c, d in f], K, E), "3 parts"),
    # arguments in another order, or something else in their place
    (lambda f, K, E: ([(d, c) for c, d in f], K, E), "is the pair .color, depth. in this order"),
    (lambda f, K, E: ([(d, o3d.geometry.Image(c)) for c, d in f], K, E), "is the pair .color, depth. in this order"),
    (lambda f, K, E: (f, E, K), "extrinsics is a PinholeCameraIntrinsic, expected a list of world-to-camera"),
    (lambda f, K, E: (f, E, [K] * 3),
     "its intrinsic is an array of float64 and its extrinsic a PinholeCameraIntrinsic"),
    (lambda f, K, E: (f, E, [K.intrinsic_matrix] * 3), "expected the other way round"),
    (lambda f, K, E: (K, f, E), "frames is a PinholeCameraIntrinsic, expected a list of RGBDImage"),
    (lambda f, K, E: (E, K, f), "a frame is an array of float64, expected an Open3D RGBDImage"),
    (lambda f, K, E: (legacy(*f[0]), K, E), "frames is a RGBDImage, expected a list"),
    (lambda f, K, E: ("RGBD", K, E), "frames is a str, expected a list"),
    (lambda f, K, E: (f, "K.json", E), "its intrinsic is a str and its extrinsic an array of float64"),
    (lambda f, K, E: (f, [parameters_of(K, e) for e in E], E), "bring their own extrinsics"),
    (lambda f, K, E: (f, [parameters_of(K, E[0]), K, K], None), "mix PinholeCameraParameters with others"),
    (lambda f, K, E: (f, parameters_of(K, E[0]), None), "1 intrinsics were given for 3 frames"),
    (lambda f, K, E: ([(c, "none.png") for c, d in f], K, E), "none.png"),
    (lambda f, K, E: ([(o3d.geometry.Image(), d) for c, d in f], K, E), "color of frame 00000 is empty, as Open3D"),
    (lambda f, K, E: ([(c, o3d.t.geometry.Image()) for c, d in f], K, E), "depth of frame 00000 is empty, as Open3D"),
])
def test_bad_input(made, change, sentence):
    colors, depths, K, E = parts(made)
    with pytest.raises(InputError, match=sentence):
        refine_rgbd(*change(list(zip(colors, depths)), K, E), config=FEW)
    for name in ("depth_trunc", "depth_scale"):
        for value in (0, -1.0, float("nan"), "1000"):
            with pytest.raises(InputError, match=f"{name} is {value!r}, expected a number above 0"):
                refine_rgbd(list(zip(colors, depths)), K, E, **{name: value}, config=FEW)


# -- Open3D's RGBD-integration tutorial on a real sequence ---------------------------------------------------------


def tutorial_loop(frames, K, poses):
    """The loop of Open3D's tutorial, with the volume that Open3D 0.20 does not leave empty."""
    tsdf = o3d.pipelines.integration
    volume = tsdf.UniformTSDFVolume(8.0, 200, 0.12, tsdf.TSDFVolumeColorType.RGB8, [-6.0, -4.0, 0.0])
    for frame, pose in zip(frames, poses):
        volume.integrate(frame, K, np.linalg.inv(pose))
    return volume.extract_triangle_mesh()


def test_tutorial_loop_with_and_without_the_step(data_dir):
    folder, chosen = data_dir / "hololens_rgbd", range(8)
    files = sorted((folder / "images").iterdir())
    poses = np.loadtxt(folder / "poses.txt").reshape(-1, 4, 4)
    fx, fy, cx, cy = np.loadtxt(folder / "K.txt")[[0, 1, 0, 1], [0, 1, 2, 2]]
    K = o3d.camera.PinholeCameraIntrinsic(135, 90, fx / 4, fy / 4, (cx + 0.5) / 4 - 0.5, (cy + 0.5) / 4 - 0.5)
    frames = []
    for k in chosen:
        color = Image.open(files[k]).resize((135, 90), Image.BOX)
        depth = Image.open(folder / "depth" / files[k].name).resize((135, 90), Image.NEAREST)
        frames.append(o3d.geometry.RGBDImage.create_from_color_and_depth(
            o3d.geometry.Image(np.ascontiguousarray(color)), o3d.geometry.Image(np.asarray(depth).astype(np.uint16)),
            depth_scale=1000.0, depth_trunc=4.0, convert_rgb_to_intensity=False))
    extrinsics = [np.linalg.inv(poses[k]) for k in chosen]
    fine = refine_rgbd(frames, K, extrinsics, config=FEW)
    changed = []
    for given, new in zip(frames, fine):
        given, new = np.asarray(given.depth), np.asarray(new.depth)
        assert np.array_equal(given > 0, new > 0)
        assert np.median(np.abs(new - given)[given > 0]) < 0.3  # metres: a pixel of parallax at this size
        changed.append((new != given).mean())
    # a frame whose photos do not fit its depth to a fraction of a pixel is kept whole, the others are refined
    assert all(share == 0 or share > 0.2 for share in changed) and np.count_nonzero(changed) >= 2
    sure = refine_rgbd(frames, K, extrinsics, config=FEW, agree_within=0.01)
    for given, new, all_new in zip(frames, sure, fine):  # each depth is the refined one or the sensor's
        given, new, all_new = (np.asarray(f.depth) for f in (given, new, all_new))
        assert ((new == given) | (new == all_new)).all()
    before, after, checked = (len(tutorial_loop(f, K, poses[list(chosen)]).vertices) for f in (frames, fine, sure))
    # at this size a pixel of parallax is 70 times the sensor's error: unchecked, photos alone do not serve it
    assert before > 1000 and after > 1000 and 0.7 < checked / before < 1.5
    with pytest.raises(InputError, match="agree_within is -1"):
        refine_rgbd(frames, K, extrinsics, config=FEW, agree_within=-1)


def test_disagreement_of_depth_maps(ring):
    """0 for exact depths of a plane; the error where one map is off; NaN where no other view looks."""
    from pagas_cl.method.surface.agree import disagreement

    depths = [plane_depth(camera, NORMAL, 0.0) for camera in ring[:3]]
    exact = disagreement(ring[0], depths[0], ring[1:3], depths[1:])
    assert np.nanmedian(exact) < 1e-6 and np.nanmax(exact) < 5e-3  # at the image border the nearest pixel is read
    assert np.isfinite(exact).mean() > 0.8
    off = disagreement(ring[0], depths[0] * np.float32(1.01), ring[1:3], depths[1:])
    assert 0.007 < np.nanmedian(off) < 0.013
    assert np.isnan(disagreement(ring[0], depths[0], [], [])).all()


# -- half pixels: these fail when Open3D changes what the pipeline relies on -----------------------------------------

NORMAL = np.array([0.3, 0.2, -0.93]) / np.linalg.norm([0.3, 0.2, -0.93])


@pytest.fixture(scope="module")
def plane():
    """A tilted plane seen off centre, its exact depth at pixel centres +0.5, and half a pixel there in depth."""
    camera = look_at((0.1, -0.05, -2), (0, 0, 0))
    return camera, plane_depth(camera, NORMAL, 0.0), 0.5 * 2.0 / camera.fx


def integrated(K, plane):
    """Mean signed distance of a VoxelBlockGrid's vertices from the plane, by Open3D's own calls."""
    camera, depth, _ = plane
    grid = o3d.t.geometry.VoxelBlockGrid(("tsdf", "weight"), (o3c.float32,) * 2, ((1), (1)), 0.02, 16, 500)
    image = o3d.t.geometry.Image(o3c.Tensor(depth[..., None]))
    pose = o3c.Tensor(np.ascontiguousarray(camera.world_to_camera))
    blocks = grid.compute_unique_block_coordinates(image, K, pose, 1.0, 10.0, 4.0)
    grid.integrate(blocks, image, K, pose, 1.0, 10.0, 4.0)
    return float((grid.extract_point_cloud(0.5).point["positions"].numpy() @ NORMAL).mean())


def test_voxel_block_grid_counts_as_measured(plane):
    camera, _, half = plane
    legacy_K = camera.K
    legacy_K[:2, 2] -= 0.5
    right = integrated(grid_intrinsic(intrinsic(camera)), plane)
    assert abs(right) < 0.05 * half
    assert np.allclose(grid_intrinsic(camera.K, pixel_center=0.5).numpy(), grid_intrinsic(legacy_K).numpy())
    assert abs(integrated(o3c.Tensor(legacy_K), plane)) > 0.1 * half  # the mistake that this saves
    # as of Open3D 0.19 and 0.20 the grid wants pixel centres at +0.5; should this fail, Open3D#7580 has been changed,
    # grid_shift() has measured it, and the first assertion above still holds
    assert np.allclose(grid_intrinsic(intrinsic(camera)).numpy(), camera.K)


def test_legacy_volume_counts_at_whole_numbers(plane):
    camera, depth, half = plane
    errors = {}
    for shift in (0.0, 0.5):
        tsdf = o3d.pipelines.integration
        volume = tsdf.UniformTSDFVolume(3.0, 150, 0.08, tsdf.TSDFVolumeColorType.NoColor, np.full(3, -1.5))
        frame = legacy(np.zeros((*depth.shape, 3), np.uint8), depth)
        K = intrinsic(camera)
        K.set_intrinsics(K.width, K.height, camera.fx, camera.fy, camera.cx - 0.5 + shift, camera.cy - 0.5 + shift)
        volume.integrate(frame, K, camera.world_to_camera)
        errors[shift] = float((np.asarray(volume.extract_point_cloud().points) @ NORMAL).mean())
    assert abs(errors[0.0]) < 0.1 * half < abs(errors[0.5])


def test_rays_go_through_centres_at_a_half(plane):
    camera, _, _ = plane
    rays = o3d.t.geometry.RaycastingScene.create_rays_pinhole(o3c.Tensor(camera.K), o3c.Tensor(np.eye(4)), camera.width,
                                                              camera.height).numpy()
    assert np.abs(rays[..., 3:] - camera.rays()).max() < 1e-6
