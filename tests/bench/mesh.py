"""How near meshes are to the truth on five made scenes (tests/bench/mesh_scenes.py): `python tests/bench/mesh.py
[SCENE ...] [--preset fast] [--width 320]` prints a row for each output. Needs Open3D, SciPy and
pymeshlab. Lengths are footprints.

Chamfer: mean of accuracy and completeness. Judged is what at least three views see of the truth; worse: share of the
given vertices that end more than half a footprint farther from the truth than they were.
"""

from __future__ import annotations

import argparse
import time

import mesh_scenes
import numpy as np

from pagas_cl.evaluate.clouds import sample_surface
from pagas_cl.keep_mesh import kept_mesh, polished, solve_device
from pagas_cl.presets import settings_of
from pagas_cl.refine import fuse_results, initial_depths, refine_views
from pagas_cl.scene.inputs import as_views
from pagas_cl.scene.mesh import Surface

SPACING = 0.8


class Cast:
    """A mesh to ask for nearest points and for what cameras see."""

    def __init__(self, vertices, faces):
        import open3d as o3d

        self.tensor, self.scene = o3d.core.Tensor, o3d.t.geometry.RaycastingScene()
        self.scene.add_triangles(self.tensor(np.ascontiguousarray(vertices, np.float32)),
                                 self.tensor(np.ascontiguousarray(faces, np.uint32)))
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        normals = np.cross(b - a, c - a)
        self.normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)

    def nearest(self, points):
        """Distances, places and normals of the nearest points."""
        found = self.scene.compute_closest_points(self.tensor(np.ascontiguousarray(points, np.float32)))
        place = found["points"].numpy()
        return np.linalg.norm(place - points, axis=1), place, self.normals[found["primitive_ids"].numpy()]

    def seen(self, points, normals, cameras) -> np.ndarray:
        """How many cameras see each point of the mesh."""
        count = np.zeros(len(points), int)
        for camera in cameras:
            (uv, z), ray = camera.project(points), points - camera.center
            length = np.linalg.norm(ray, axis=1)
            ok = np.flatnonzero((z > 0) & (uv > 2).all(1) & (uv < (camera.width - 2, camera.height - 2)).all(1)
                                & (-(ray * normals).sum(1) > 0.1 * length))
            rays = np.concatenate([np.broadcast_to(camera.center, (len(ok), 3)), ray[ok]], 1).astype(np.float32)
            count[ok] += self.scene.cast_rays(self.tensor(rays))["t_hit"].numpy() > 1 - 1 / length[ok]
        return count


def self_intersecting(vertices, faces) -> int:
    """Triangles of a mesh that cross others of it."""
    import pymeshlab

    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(vertices, faces))
    meshes.compute_selection_by_self_intersections_per_face()
    return meshes.current_mesh().selected_face_number()


class Truth:
    """The true surface of a scene, against which meshes are judged."""

    def __init__(self, scene):
        self.cameras, self.cast = scene.cameras, Cast(*scene.true)
        points = sample_surface(*scene.true, SPACING)
        _, _, normals = self.cast.nearest(points)
        self.points = points[self.cast.seen(points, normals, self.cameras) >= 3]

    def row(self, vertices, faces, given=None) -> dict[str, float]:
        """Figures of a mesh; of `given` vertices those that come first were moved."""
        mesh, samples = Cast(vertices, faces), sample_surface(vertices, faces, SPACING)
        own = mesh.nearest(samples)[2]
        away, place, normals = self.cast.nearest(samples)
        judged = self.cast.seen(place, normals, self.cameras) >= 3
        away, back = away[judged], mesh.nearest(self.points)[0]
        angle = np.degrees(np.arccos(np.clip((own * normals)[judged].sum(axis=1), -1, 1)))
        out = {"Chamfer": (away.mean() + back.mean()) / 2, "accuracy 90": np.percentile(away, 90),
               "completeness 90": np.percentile(back, 90), "normals": angle.mean(), "within 1": 100 * (away < 1).mean(),
               "within 2": 100 * (away < 2).mean(), "triangles": len(faces)}
        out["crossing"] = self_intersecting(vertices, faces)
        if given is not None:
            before, after = self.cast.nearest(given)[0], self.cast.nearest(vertices[:len(given)])[0]
            out["worse"] = 100 * (after > before + 0.5).mean()
        return out


def outputs(scene, preset: str):
    """(name, mesh, seconds) of every output."""
    config, views = settings_of(preset, None), as_views(scene.cameras, scene.photos, None)
    given, plain = Surface(*scene.given), config.with_settings(fusion__polish=False)
    depths = initial_depths(given, views)
    results = refine_views(views, depths, config=config)
    yield "given", given, 0.0
    start = time.perf_counter()
    fused = fuse_results(views, results, plain)
    yield "tsdf, not polished", fused, time.perf_counter() - start
    for name, make in (("tsdf", lambda: polished(fused, results, config, solve_device(None))),
                       ("mesh, all splits", lambda: kept_mesh(given, views, results, config, "displace", 1.5)),
                       ("mesh", lambda: kept_mesh(given, views, results, config)),
                       ("mesh, flat=0.3", lambda: kept_mesh(given, views, results, config, flat=0.3)),
                       ("displace", lambda: kept_mesh(given, views, results, config, "displace"))):
        start = time.perf_counter()
        mesh = make()
        yield name, mesh, time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="*", default=["relief", "wires", "closed", "sheet", "box"])
    parser.add_argument("--preset", default="balanced")
    parser.add_argument("--width", type=int, default=320)
    asked = parser.parse_args()
    for name in asked.scenes:
        scene = getattr(mesh_scenes, name)(asked.width)
        truth = Truth(scene)
        for output, mesh, seconds in outputs(scene, asked.preset):
            moved = None if output.startswith("tsdf") else scene.given[0]
            row = truth.row(mesh.vertices, mesh.faces, moved)
            figures = " | ".join(f"{key} {value:.4g}" for key, value in {**row, "s": seconds}.items())
            print(f"{name} | {output} | {figures}", flush=True)


if __name__ == "__main__":
    main()
