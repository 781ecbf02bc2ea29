import open3d as o3d
from pagas_cl.filters.open3d_pipeline import refine_and_integrate

cameras = o3d.io.read_pinhole_camera_trajectory("RGBD/trajectory.json")
frames = [(f"RGBD/color/{k:06}.png", f"RGBD/depth/{k:06}.png") for k in range(len(cameras.parameters))]
mesh = refine_and_integrate(frames, cameras, voxel_size=0.02)
o3d.io.write_triangle_mesh("fine.ply", mesh.to_legacy())
