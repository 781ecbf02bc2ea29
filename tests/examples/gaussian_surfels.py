from pathlib import Path

import open3d as o3d
import pagas_cl

# 2DGS writes fuse_post.ply below train/, PGSR mesh/tsdf_fusion_post.ply, both in the world of the COLMAP model
scene = pagas_cl.read_scene("SCENE")
fine = pagas_cl.refine_mesh(next(Path("train").rglob("fuse_post.ply")), scene.cameras, scene.images)
mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(fine.vertices), o3d.utility.Vector3iVector(fine.faces))
o3d.io.write_triangle_mesh("fine.ply", mesh)
