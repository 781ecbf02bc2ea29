"""How near meshes are to the truth on synthetic scenes (tests/bench/mesh_scenes.py), a row for each output.

    python tests/bench/mesh.py [SCENE ...] [--preset fast] [--width 320] [--json FILE]

Needs Open3D, SciPy and pymeshlab. Lengths are footprints. Chamfer: mean of accuracy and completeness; 90 %: their mean
90th percentile. Judged is what at least three views see of the truth; worse: share of the given vertices that end more
than half a footprint farther from the truth than they were.
"""

from __future__ import annotations

import argparse

import mesh_scenes
import numpy as np
from record import add_json, record

from pagas_cl.app.evaluate.clouds import sample_surface
from pagas_cl.config.presets import settings_of
from pagas_cl.jobs.fusing import fuse_results
from pagas_cl.method.surface.keep_mesh import kept_mesh, polished, solve_device
from pagas_cl.method.surface.mesh_levels import TOLERANCE
from pagas_cl.method.surface.mesh_options import MeshOptions
from pagas_cl.refine import initial_depths, refine_views
from pagas_cl.scene.inputs import as_views
from pagas_cl.scene.mesh import Surface

SPACING = 0.8       # footprints between samples of a surface
SCENES = ("relief", "wires", "closed", "sheet", "box", "relief_1", "relief_2")
HALF = "mesh, half the `triangles`"
MARK = "number"     # attribute by which given vertices are known among those that are left
TITLE = "Meshes against the truth"
MEASURED = ("Synthetic scenes with true surfaces, preset `balanced`, lengths in pixels on the surface: Chamfer "
            "distance (mean of accuracy and completeness), their mean 90th percentile, mean angle of normals in "
            "degrees, share within 1 and 2 pixels of the truth, triangles, those that cross others (pymeshlab), share "
            "of given vertices that end more than half a pixel farther from the truth. The constants of the mesh were "
            "chosen on relief, wires and box.")


class Cast:
    """Nearest points of a mesh, and what cameras see of it."""

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

    def row(self, mesh, given=None) -> dict[str, float]:
        """Figures of a mesh; its vertices that have a number of `given` ones were moved from there."""
        vertices, faces = mesh.vertices, mesh.faces
        cast, samples = Cast(vertices, faces), sample_surface(vertices, faces, SPACING)
        own = cast.nearest(samples)[2]
        away, place, normals = self.cast.nearest(samples)
        judged = self.cast.seen(place, normals, self.cameras) >= 3
        away, back = away[judged], cast.nearest(self.points)[0]
        angle = np.degrees(np.arccos(np.clip((own * normals)[judged].sum(axis=1), -1, 1)))
        out = {"Chamfer": (away.mean() + back.mean()) / 2,
               "90 %": (np.percentile(away, 90) + np.percentile(back, 90)) / 2, "normals": angle.mean(),
               "within 1": 100 * (away < 1).mean(), "within 2": 100 * (away < 2).mean(), "triangles": len(faces),
               "crossing": self_intersecting(vertices, faces)}
        if given is not None:
            number, places = given.attributes[MARK], np.argsort(given.attributes[MARK])
            of = places[np.minimum(np.searchsorted(number[places], mesh.attributes[MARK]), len(places) - 1)]
            same = number[of] == mesh.attributes[MARK]
            before, after = self.cast.nearest(given.vertices[of[same]])[0], self.cast.nearest(vertices[same])[0]
            out["worse, %"] = 100 * (after > before + 0.5).mean()
        return out


def outputs(scene, preset: str):
    """(name, mesh) of every output."""
    config, views = settings_of(preset, None), as_views(scene.cameras, scene.photos, None)
    numbers = np.random.default_rng(0).uniform(size=len(scene.given[0]))     # no mean of two is a third
    given = Surface(*scene.given, attributes={MARK: numbers})
    results = refine_views(views, initial_depths(given, views), config=config)
    yield "given", given
    fused = fuse_results(views, results, config.with_settings(fusion__polish=False))
    yield "tsdf", fused
    yield "tsdf, `fusion.polish`", polished(fused, results, config, solve_device(None))
    yield "displace", kept_mesh(given, views, results, config, MeshOptions("displace")).mesh
    mesh = kept_mesh(given, views, results, config, MeshOptions("mesh", tolerance=TOLERANCE)).mesh     # MARK may go
    yield "mesh", mesh
    yield HALF, kept_mesh(given, views, results, config, MeshOptions("mesh", triangles=len(mesh.faces) // 2)).mesh


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="*", default=SCENES)
    parser.add_argument("--preset", default="balanced")
    parser.add_argument("--width", type=int, nargs="?", help="of the photos; each scene has its own by default")
    add_json(parser)
    given, rows = parser.parse_args(), []
    for name in given.scenes:
        scene = getattr(mesh_scenes, name)(*[given.width] * (given.width is not None))
        truth = Truth(scene)
        for output, mesh in outputs(scene, given.preset):
            if output == "given":
                given_mesh = mesh
            moved = given_mesh if output.startswith(("mesh", "displace")) else None
            rows.append({"scene": name, "mesh": output, **truth.row(mesh, moved)})
    record(TITLE, MEASURED, solve_device(None).info.title, rows, given.json)


if __name__ == "__main__":
    main()
