"""Context choice and the check that the cameras see the mesh."""

import numpy as np
import pytest
from conftest import look_at, plane_depth
from support.scenes import relief_scene

from pagas_cl.config import Context
from pagas_cl.errors import InputError
from pagas_cl.scene.camera import Camera, inverse_pose
from pagas_cl.scene.check.cameras import check_cameras, check_seen, sample_points
from pagas_cl.scene.choice import ContextChooser
from pagas_cl.scene.mesh import Surface
from pagas_cl.scene.sampling import sample_depth, sample_pixels


def choose_contexts(target, cameras, depths, *settings):
    return ContextChooser(cameras, depths, *settings).choose(target)


FRONT = (0.0, 0.0, -1.0)  # normal of the plane z = 0


def arc(degrees, distance=4.0):
    a = np.radians(degrees)
    return look_at((distance * np.sin(a), 0, -distance * np.cos(a)), (0, 0, 0), name=f"{degrees}")


def depths_of(cameras):
    return [plane_depth(camera, FRONT, 0) for camera in cameras]


def test_useful_angles_come_first_and_useless_ones_not_at_all():
    cameras = [arc(d) for d in (0, 0.2, 5, 12, 45, 85)]
    choice = choose_contexts(0, cameras, depths_of(cameras), Context(number=3))
    assert choice.indices == (3, 2, 4) and choice.reason == ""
    assert choice.angles == pytest.approx([12, 5, 45], abs=4) and min(choice.overlaps) > 0.5
    more = choose_contexts(0, cameras, depths_of(cameras), Context(number=5))
    assert set(more.indices) == {2, 3, 4}
    assert more.reason == ("3 of 5 other views are usable: 1 are too close to its place (rays below 1 degrees); "
                           "1 look from too far to the side (rays above 60 degrees)")


def test_views_that_look_away_or_from_behind_a_wall_are_left_out():
    away = look_at((0.5, 0, -4), (0.5, 0, -10), name="away")
    cameras = [arc(0), away, arc(10)]
    depths = depths_of(cameras[:1]) + [None] + depths_of(cameras[2:])
    choice = choose_contexts(0, cameras, depths)
    assert choice.indices == (2,) and "1 see less than 10% of what it sees" in choice.reason
    depths[2] = np.full_like(depths[2], 1.0)  # a wall right in front of it
    choice = choose_contexts(0, cameras, depths)
    assert choice.indices == () and "1 are blocked by nearer surfaces" in choice.reason
    depths[2] = None  # nothing known: nothing hidden
    assert choose_contexts(0, cameras, depths).indices == (2,)


def test_no_depth_no_context():
    cameras = [arc(0), arc(10)]
    for depth in (None, np.zeros((120, 160), np.float32), np.full((120, 160), np.nan, np.float32),
                  np.full((120, 160), np.inf, np.float32)):
        choice = choose_contexts(0, cameras, [depth, None])
        assert choice.indices == () and "no valid pixel" in choice.reason
    alone = choose_contexts(0, cameras[:1], depths_of(cameras[:1]))
    assert alone.indices == () and alone.reason == "there is no other view"


def test_every_part_of_the_target_gets_a_view():
    """Six views see its left half only and one the right half: with three, the one must be among them."""
    target = arc(0)
    left = [look_at((-1.5 + 0.1 * k, 0.05 * k, -4), (-1.5, 0, 0), name=f"l{k}") for k in range(6)]
    right = look_at((1.5, 0, -4), (1.5, 0, 0), name="r")
    cameras = [target, *left, right]
    assert 7 in choose_contexts(0, cameras, depths_of(cameras), Context(number=3)).indices


def test_coarse_views_rank_below_fine_ones():
    near, far = arc(12), arc(-12, distance=20)
    cameras = [arc(0), far, near]
    assert choose_contexts(0, cameras, depths_of(cameras)).indices[0] == 2


@pytest.mark.parametrize("scale, offset", [(1e-3, 0), (1e3, 0), (1, 5e6)])
def test_unit_and_origin_do_not_matter(scale, offset):
    cameras = [arc(d) for d in (0, 4, 12, 35)]
    moved = []
    for c in cameras:
        pose = c.world_to_camera.copy()
        pose[:3, 3] = -pose[:3, :3] @ (c.center * scale + offset)
        moved.append(Camera(c.width, c.height, c.fx, c.fy, c.cx, c.cy, pose))
    depths = depths_of(cameras)
    a, b = choose_contexts(0, cameras, depths), choose_contexts(0, moved, [d * np.float32(scale) for d in depths])
    assert a.indices == b.indices and np.allclose(a.overlaps, b.overlaps, atol=0.01)


def grid(side):
    pose, cameras = np.diag([1.0, -1, -1, 1]), []
    for i in range(side * side):
        place = np.array([15.0 * (i % side), 15.0 * (i // side), 100.0])
        full = pose.copy()
        full[:3, 3] = -pose[:3, :3] @ place
        cameras.append(Camera(160, 120, 150, 150, 80, 60, full, str(i)))
    return cameras


def test_many_cameras_give_the_same_as_looking_at_all(monkeypatch):
    cameras = grid(12)
    depths = [sample_depth(np.full((120, 160), 100, np.float32))] * len(cameras)
    cut = ContextChooser(cameras, depths)
    quick = [cut.choose(i) for i in range(0, 144, 13)]
    monkeypatch.setattr("pagas_cl.scene.choice._MANY", 10**9)
    full = [cut.choose(i) for i in range(0, 144, 13)]
    assert quick == full and all(len(c.indices) == 10 for c in quick)


def test_ten_thousand_cameras_stay_fast():
    cameras = grid(100)
    chooser = ContextChooser(cameras, [sample_depth(np.full((120, 160), 100, np.float32))] * len(cameras))
    assert len(chooser._candidates(5050, chooser._points(5050)[0])) <= 32
    assert len(chooser.choose(5050).indices) == 10


def test_a_sample_stands_for_its_depth_map():
    depth = np.zeros((121, 161), np.float32)
    depth[30:50, 60:90] = np.random.default_rng(0).uniform(2, 3, (20, 30))
    sample = sample_depth(depth)
    assert np.array_equal(depth[sample.rows, sample.columns], sample.depth) and len(sample.depth) > 300
    rows, columns = np.nonzero(depth)
    assert (sample.farthest[rows // sample.cell, columns // sample.cell] >= depth[rows, columns]).all()
    assert sample.farthest.max() == depth.max() and np.count_nonzero(sample.farthest) < sample.farthest.size / 5
    rows, columns = sample_pixels(np.ones((1000, 3000)), 2000)
    assert 1000 <= len(rows) <= 2000 and np.ptp(rows) > 900 and np.ptp(columns) > 2800


def test_sizes_must_fit():
    with pytest.raises(InputError, match="160 x 120"):
        choose_contexts(0, [arc(0), arc(5)], [np.ones((4, 4), np.float32), None])
    with pytest.raises(InputError, match="1 depth maps were given for 2 views"):
        choose_contexts(0, [arc(0), arc(5)], [None])


# -- check_seen ------------------------------------------------------------------------------------------------------

FLIP = np.diag([1.0, -1, -1, 1])


def ball(centre=(0.3, 0.2, 0.1), radius=0.4):
    """Triangles whose corners lie on a sphere."""
    points = np.random.default_rng(0).normal(size=(300, 3))
    return Surface(np.asarray(centre) + radius * points / np.linalg.norm(points, axis=1, keepdims=True),
                   np.arange(300).reshape(-1, 3))


def round_the_ball(n=12):
    return [look_at((3 * np.sin(a), 0.6, -3 * np.cos(a)), (0.3, 0.2, 0.1), name=f"{i}")
            for i, a in enumerate(np.linspace(0, 5.5, n))]


def read_as(cameras, change):
    return [Camera(c.width, c.height, c.fx, c.fy, c.cx, c.cy, change(c.world_to_camera), c.name) for c in cameras]


def test_right_cameras_pass():
    assert check_seen(ball(), round_the_ball()).min() > 0.9


@pytest.mark.parametrize("change, message", [
    (inverse_pose, r"with the inverse matrices 12 of 12 do: pass Camera.from_c2w\(...\)"),
    (lambda p: FLIP @ p, r"flipped \(OpenGL axes\) 12 of 12 do: pass Camera.from_opengl_c2w\(...\)"),
    (lambda p: inverse_pose(FLIP @ p), r"inverse matrices and y and z flipped.* 12 of 12 do: pass .*from_opengl_c2w"),
])
def test_other_readings_are_named(change, message):
    with pytest.raises(InputError, match=message) as error:
        check_seen(ball(), read_as(round_the_ball(), change))
    assert "of 12 cameras see the mesh" in str(error.value)


def test_opengl_says_that_the_mesh_lies_behind():
    with pytest.raises(InputError, match="0 of 12 cameras see the mesh, it lies behind 12 of 12"):
        check_seen(ball(), read_as(round_the_ball(), lambda p: FLIP @ p))


def test_mesh_that_no_camera_sees():
    with pytest.raises(InputError, match="0 of 3 cameras see the mesh.*scaled by 0.001 3 of 3 do.*another unit"):
        check_seen(ball((0.0003, 500.0002, 0.0001), 0.0004), round_the_ball(3))
    vertices, faces = relief_scene(64, 48, 2, held_out=0).initial_mesh()
    with pytest.raises(InputError, match="with the mesh scaled by 0.001 3 of 3 do"):  # a few points by chance
        check_seen(Surface(vertices * 1000, faces), [v.camera for v in relief_scene(64, 48, 2, held_out=0).views])
    with pytest.raises(InputError, match="no cameras"):
        check_seen(ball(), [])


@pytest.mark.parametrize("kept, said", [(np.float64, False), (np.float32, True)])
def test_a_mesh_at_map_coordinates_that_single_precision_has_rounded(caplog, kept, said):
    """At the northings of a UTM zone it keeps half a metre; what then looks like wrong cameras is named."""
    offset, mesh = np.array([451234.5, 5411234.25, 321]), ball()
    shift = np.eye(4)
    shift[:3, 3] = -offset
    rounded = Surface((mesh.vertices + offset).astype(kept), mesh.faces)
    assert check_seen(rounded, read_as(round_the_ball(), lambda p: p @ shift)).min() > 0.4
    assert ("steps of 0.5 units" in caplog.text and "write it in double precision" in caplog.text) == said
    assert said or not caplog.text
    check_cameras(rounded, read_as(round_the_ball(), lambda p: p @ shift))
    check_seen(Surface(mesh.vertices.astype(np.float32), mesh.faces), round_the_ball())     # near the origin: no harm
    assert len(caplog.records) == 2 * said


def test_some_cameras_may_look_away():
    cameras = round_the_ball(6)
    for i in (0, 2, 3, 5):
        cameras[i] = look_at(cameras[i].center, cameras[i].center * 2, name="away")
    share = check_seen(ball(), cameras)
    assert (share > 0).sum() == 2


def test_large_triangles_are_seen_by_their_faces():
    big = Surface([(-100, -100, 0), (100, -100, 0), (0, 100, 0)], [[0, 1, 2]])
    cameras = [arc(0), arc(10)]
    assert check_seen(big, cameras).min() > 0
    points = sample_points(big, 500)
    assert np.allclose(points[:, 2], 0) and np.array_equal(points, sample_points(big, 500))
