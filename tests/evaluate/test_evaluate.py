"""Evaluation: every figure against brute force or a case with a known answer."""

import json

import numpy as np
import pytest
from support.scenes import relief_scene, tiny

from pagas_cl.app.evaluate.clouds import VisibleSpace, chamfer, f_score, sample_surface, thin
from pagas_cl.app.evaluate.depth import compare_depth, depth_per_parallax, dilate, find_discontinuities
from pagas_cl.errors import InputError
from pagas_cl.method.view.prediction import compare_predictions, correlate, predict_photo
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.depthmap import central_normals as depth_normals


def camera(width=40, height=30, f=50.0):
    return Camera(width, height, f, f, width / 2, height / 2, np.eye(4))


def all_distances(a, b):
    return np.sqrt(((a[:, None] - b[None]) ** 2).sum(-1))


@pytest.fixture
def clouds():
    pytest.importorskip("scipy")
    rng = np.random.default_rng(5)
    return rng.uniform(0, 1, (300, 3)), rng.uniform(0, 1.1, (400, 3))


def test_chamfer_against_brute_force(clouds):
    pytest.importorskip("scipy")
    result, truth = clouds
    table = all_distances(result, truth)
    found = chamfer(result, truth)
    assert found.accuracy == pytest.approx(table.min(1).mean(), rel=1e-12)
    assert found.completeness == pytest.approx(table.min(0).mean(), rel=1e-12)
    assert found.overall == pytest.approx((found.accuracy + found.completeness) / 2)
    assert found.accuracy_median == pytest.approx(np.median(table.min(1)))
    near = table.min(1)[table.min(1) < 0.08]
    assert chamfer(result, truth, max_distance=0.08).accuracy == pytest.approx(near.mean())


def test_chamfer_with_visible_space_and_ground(clouds):
    pytest.importorskip("scipy")
    result, truth = clouds
    seen = np.zeros((6, 6, 6), bool)
    seen[:3] = True  # voxels centred at x = 0, 0.2, 0.4: x < 0.5
    visible = VisibleSpace(seen, np.zeros(3), np.full(3, 0.8), 0.2, margin=0.05)
    plane = np.array([0, 0, 1.0, -0.3])
    found = chamfer(result, truth, visible=visible, ground=plane)
    in_box = result[((result >= -0.05) & (result < 0.9)).all(1)]
    judged = in_box[in_box[:, 0] < 0.5]
    wanted = truth[truth[:, 2] > 0.3]
    assert found.accuracy == pytest.approx(all_distances(judged, truth).min(1).mean())
    assert found.completeness == pytest.approx(all_distances(wanted, in_box).min(1).mean())
    assert (found.result_points, found.truth_points) == (len(judged), len(wanted))


def test_thinning_is_the_greedy_loop(clouds):
    pytest.importorskip("scipy")
    points = clouds[0]
    order = np.argsort(np.random.default_rng(0).permutation(len(points)))
    kept = np.zeros(len(points), bool)
    gone = np.zeros(len(points), bool)
    for i in order:
        if not gone[i]:
            kept[i] = True
            gone |= np.linalg.norm(points - points[i], axis=1) <= 0.15
    assert np.array_equal(thin(points, 0.15), kept)
    assert kept.sum() < 0.9 * len(points)


def test_f_score_against_brute_force(clouds):
    pytest.importorskip("scipy")
    result, truth = clouds
    table = all_distances(result, truth)
    found = f_score(result, truth, 0.06)
    p, r = (table.min(1) < 0.06).mean(), (table.min(0) < 0.06).mean()
    assert (found.precision, found.recall) == (p, r)
    assert found.f_score == pytest.approx(2 * p * r / (p + r))
    assert f_score(result, result, 1e-9).f_score == 1
    assert f_score(result, truth + 100, 0.1).f_score == 0


def test_sampling_follows_area():
    vertices = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [4, 4, 1], [9, 9, 9.0]])
    faces = np.array([[0, 1, 2], [1, 3, 2], [4, 4, 4]])
    points = sample_surface(vertices, faces, 0.1)
    first = 8.0
    second = 0.5 * np.linalg.norm(np.cross(vertices[3] - vertices[1], vertices[2] - vertices[1]))
    assert len(points) == round((first + second) / 0.01)
    flat = points[points[:, 2] == 0]
    assert abs(len(flat) - first / 0.01) <= 1
    assert np.allclose(flat.mean(0), [4 / 3, 4 / 3, 0], atol=0.03)
    assert all_distances(flat, flat[:50])[all_distances(flat, flat[:50]) > 0].min() > 0.02  # even, no clumps
    assert np.array_equal(points, sample_surface(vertices, faces, 0.1))
    with pytest.raises(InputError, match="no area"):
        sample_surface(vertices, faces[2:], 0.1)


def test_depth_errors_of_a_known_case():
    cam = camera()
    truth = np.full((30, 40), 10.0)
    truth[:, 20:] = 20.0
    depth = truth + 0.1
    depth[:, 20:] += 0.3
    depth[0, 0] = 0
    report = compare_depth(depth, truth, cam, parallax=0.5)
    assert report.smooth.missing == 1 and report.edges.pixels == 30 * 8  # 4 columns on each side of the step
    assert report.smooth.pixels + report.edges.pixels == report.all.pixels == 1199
    assert report.all.mean == pytest.approx((0.1 * 599 + 0.4 * 600) / 1199)
    assert report.all.mean_parallax == pytest.approx(report.all.mean / 0.5)
    assert report.smooth.normal_mean == pytest.approx(0, abs=1e-6)


def test_normals_of_a_tilted_plane():
    cam = camera()
    normal = np.array([0.3, -0.4, -1.0])
    normal /= np.linalg.norm(normal)
    depth = -8 / (cam.rays() @ normal) * 1.0
    measured = depth_normals(depth, cam)
    assert np.isnan(measured[0]).all() and np.isnan(measured[:, -1]).all()
    assert np.allclose(measured[1:-1, 1:-1], normal, atol=1e-12)
    depth[10, 10] = 0
    assert np.isnan(depth_normals(depth, cam)[9:12, 10]).all()


def test_discontinuities_and_dilation():
    depth = np.full((12, 12), 5.0)
    depth[4:8, 4:8] = 3.0
    found = find_discontinuities(depth, camera(12, 12))
    assert found[4, 4] and found[3, 4] and found[4, 3] and not found[3, 3] and not found[5, 5]
    one = np.zeros((9, 9), bool)
    one[4, 4] = True
    y, x = np.mgrid[-4:5, -4:5]
    assert np.array_equal(dilate(one, 3), x**2 + y**2 <= 9)
    assert np.array_equal(dilate(one, 0), one)


def test_parallax_unit_moves_by_one_pixel():
    made = tiny()
    target, context = made.cameras[0], made.cameras[1]
    depth = made.true_depth(target).astype(np.float64)
    one_pixel = depth_per_parallax(depth, target, [context])
    assert 0.5 < (one_pixel > 0).mean()

    def seen(d):
        points = (d[..., None] * target.rays()) @ target.world_to_camera[:3, :3] + target.center
        return context.project(points)[0]

    moved = np.linalg.norm(seen(depth + 0.01 * one_pixel) - seen(depth - 0.01 * one_pixel), axis=-1)
    assert np.allclose(moved[one_pixel > 0], 0.02, rtol=1e-4)


def test_correlation_against_numpy():
    rng = np.random.default_rng(2)
    a, b = rng.uniform(0, 255, (2, 12, 15))
    valid = np.ones(a.shape, bool)
    valid[2, 3] = False
    score = correlate(a, b, valid)
    assert np.isnan(score[:, :3]).all() and np.isnan(score[3, 3]) and np.isnan(score[5, 6])
    assert score[6, 7] == pytest.approx(np.corrcoef(a[3:10, 4:11].ravel(), b[3:10, 4:11].ravel())[0, 1], abs=1e-6)
    assert correlate(a, 0.5 * a + 20, valid)[7, 9] == pytest.approx(1, abs=1e-6)  # blind to gain and offset


@pytest.mark.slow
def test_prediction_prefers_the_true_depth_and_one_set_of_pixels():
    made = relief_scene(194, 145, contexts=5, held_out=1)
    target, other = made.views[0], made.held_out[0]
    true = made.true_depth(target.camera)
    wrong = true + 1.5 * np.float32(made.relief.parallax)
    holed = true.copy()
    holed[50:75, 50:75] = 0
    best, worse, same = compare_predictions(target, [true, wrong, holed], other)
    assert best.median > worse.median + 0.05
    assert best.pixels == worse.pixels == same.pixels and best.median == same.median


def test_hidden_pixels_are_left_out():
    made = tiny(bar=8.0)
    target, other = made.views[0], made.held_out[0]
    depth = made.true_depth(target.camera)
    seen = predict_photo(target, depth, other, made.true_depth(other.camera))
    everything = predict_photo(target, depth, other, np.zeros((72, 96)))
    assert 0 < seen.pixels < everything.pixels
    assert seen.mean > everything.mean


@pytest.mark.parametrize("call, said", [
    (lambda: chamfer(np.zeros((0, 3)), np.zeros((1, 3))), "result cloud is empty"),
    (lambda: chamfer(np.zeros((2, 2)), np.zeros((1, 3))), r"shape \(2, 2\)"),
    (lambda: chamfer(np.zeros((2, 3)), np.ones((1, 3)), ground=(0, 0, 1, -5)), "truth above the ground plane"),
    pytest.param(lambda: chamfer(np.zeros((2, 3)), np.ones((1, 3)), max_distance=1.5),
                 "no point of the result lies within 1.5", marks=pytest.mark.slow),      # needs SciPy
    (lambda: f_score(np.zeros((2, 3)), np.full((1, 3), np.nan), 1), "not finite"),
    (lambda: f_score(np.zeros((2, 3)), np.zeros((1, 3)), 0), "threshold is 0"),
    (lambda: compare_depth(np.ones((3, 4)), np.ones((30, 40)), camera()), "4 x 3"),
    *((lambda name=name, shape=shape: compare_depth(np.ones((30, 40)), np.ones((30, 40)), camera(),
                                                    **{name: np.ones(shape)}), rf"{name} has shape .*expected \(30, 40")
      for name, shape in (("parallax", 40), ("mask", (40, 30)), ("true_normals", 3))),
])
def test_bad_input(call, said):
    with pytest.raises(InputError, match=said):
        call()


def test_dtu_files(tmp_path):
    pytest.importorskip("scipy")
    from scipy.io import savemat

    from pagas_cl.app.evaluate.clouds import load_ground, load_visible

    savemat(tmp_path / "mask.mat", {"ObsMask": np.ones((2, 3, 4), np.uint8), "BB": np.array([[0, 0, 0], [1, 2, 3.0]]),
                                    "Res": 0.5})
    savemat(tmp_path / "plane.mat", {"P": np.array([[0.0], [0], [1], [-2]])})
    visible = load_visible(tmp_path / "mask.mat")
    assert visible.seen.shape == (2, 3, 4) and visible.voxel == 0.5 and list(visible.far_corner) == [1, 2, 3]
    assert list(load_ground(tmp_path / "plane.mat")) == [0, 0, 1, -2]
    with pytest.raises(InputError, match="no variable 'P'"):
        load_ground(tmp_path / "mask.mat")
    with pytest.raises(InputError, match="no file"):
        load_ground(tmp_path / "none.mat")


def test_command_on_clouds(tmp_path, capsys):
    pytest.importorskip("scipy")
    from pagas_cl.__main__ import run

    rng = np.random.default_rng(0)
    truth = rng.uniform(0, 10, (2000, 3))
    np.save(tmp_path / "truth.npy", truth)
    np.savetxt(tmp_path / "result.xyz", truth + [0.1, 0, 0])
    status = run(["evaluate", str(tmp_path / "result.xyz"), str(tmp_path / "truth.npy"), "--threshold", "0.2",
                  "--spacing", "0.01", "--json", str(tmp_path / "figures.json")])
    assert status == 0 and "accuracy" in capsys.readouterr().out
    figures = json.loads((tmp_path / "figures.json").read_text())["figures"]
    (distances,), (shares,) = (list(group.values()) for group in figures.values())
    assert 0.09 < distances["accuracy"] <= 0.1 and shares["f_score"] == 1
    assert run(["evaluate", str(tmp_path / "nothing.ply"), str(tmp_path / "truth.npy")]) == 2
    assert run(["evaluate", str(tmp_path / "result.xyz")]) == 2
    assert run(["evaluate", str(tmp_path)]) == 2
    assert "--scene" in capsys.readouterr().err


def test_a_mesh_against_itself_and_a_shifted_one(tmp_path, capsys):
    """Distances between meshes are to their surfaces; between points they have a floor, which is reported."""
    pytest.importorskip("open3d")
    from pagas_cl.__main__ import run
    from pagas_cl.scene.mesh import Surface
    from pagas_cl.scene.meshes.files import write_mesh

    x, y = np.meshgrid(np.arange(11.0), np.arange(11.0))
    vertices = np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()]) + [5e5, 4e6, 0]
    k = (np.arange(10)[:, None] * 11 + np.arange(10)).ravel()
    faces = np.concatenate([np.column_stack([k, k + 1, k + 11]), np.column_stack([k + 1, k + 12, k + 11])])
    for name, up in (("a", 0.0), ("b", 0.01)):
        write_mesh(tmp_path / f"{name}.ply", Surface(vertices + [0, 0, up], faces))
    np.save(tmp_path / "cloud.npy", sample_surface(vertices, faces, 0.1))

    def figures(result, truth, *more):
        status = run(["evaluate", str(tmp_path / result), str(tmp_path / truth), "--json", str(tmp_path / "f.json"),
                      "--threshold", "0.005", *more])
        assert status == 0
        title = capsys.readouterr().out
        first, shares = json.loads((tmp_path / "f.json").read_text())["figures"].values()
        return title, first[""], shares["0.005"]["f_score"]

    title, same, share = figures("a.ply", "a.ply")
    assert same["overall"] < 1e-5 and share == 1 and "to the surface;" in title and "below about" not in title
    _, shifted, share = figures("b.ply", "a.ply")
    assert shifted["overall"] == pytest.approx(0.01, rel=0.01) and share == 0
    title, points, _ = figures("a.ply", "cloud.npy")
    floor = float(title.split("below about ")[1].split()[0])
    assert "to the surface of one, to the points of the other" in title and 0.3 * floor < points["accuracy"] < 3 * floor
    title, points, _ = figures("a.ply", "a.ply", "--spacing", "0.1")
    assert "(to points; points every 0.1)" in title and points["overall"] > 0.001 and "below about" in title


def test_a_photo_from_behind_does_not_judge(tmp_path, capsys):
    """Through a ball the two sides of it would be compared, over which no photos agree."""
    import trimesh

    from pagas_cl.__main__ import run
    from pagas_cl.scene.images import write_image
    from pagas_cl.scene.mesh import Surface
    from pagas_cl.scene.meshes.files import write_mesh
    from pagas_cl.scene.readers import camera_file
    from pagas_cl.scene.view import View

    ball, rng = trimesh.creation.icosphere(3), np.random.default_rng(0)
    (tmp_path / "images").mkdir()
    views = []
    for name, degrees in (("front", 0), ("side", 20), ("behind", 180)):
        s, c = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
        pose = np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 4], [0, 0, 0, 1]])
        photo = tmp_path / "images" / f"{name}.png"
        write_image(photo, rng.integers(0, 256, (30, 40, 3), dtype=np.uint8))
        views.append(View(Camera(40, 30, 50.0, 50.0, 20, 15, pose), photo, name=photo.name))
    camera_file.write(tmp_path, views)
    write_mesh(tmp_path / "ball.ply", Surface(np.array(ball.vertices), np.array(ball.faces)))
    status = run(["evaluate", str(tmp_path / "ball.ply"), "--scene", str(tmp_path), "--held-out", "front.png",
                  "--json", str(tmp_path / "figures.json")])
    assert status == 0 and "left out are 1 of 2 pairs of a view and a held-out photo" in capsys.readouterr().err
    figures = json.loads((tmp_path / "figures.json").read_text())["figures"]
    assert list(figures["correlation of held-out photos"]) == ["side.png from front.png"]
    write_mesh(tmp_path / "ball.ply", Surface(0.1 * np.array(ball.vertices), np.array(ball.faces)))
    assert run(["evaluate", str(tmp_path / "ball.ply"), "--scene", str(tmp_path), "--held-out", "front.png"]) == 2
    assert "has a textured patch of 7 x 7 pixels that a held-out view" in capsys.readouterr().err
