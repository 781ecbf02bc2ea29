import open3d as o3d
from pagas_cl.filters.open3d_pipeline import refine_and_integrate

cameras = o3d.io.read_pinhole_camera_trajectory("RGBD/trajectory.json")
frames = [(f"RGBD/color/{k}.png", f"RGBD/depth/{k}.png") for k in range(len(cameras.parameters))]
mesh = refine_and_integrate(frames, cameras, depth_scale=50.0, voxel_size=8.0)
o3d.io.write_triangle_mesh("fine.ply", mesh.to_legacy())
