import open3d as o3d
from pagas_cl.filters.open3d_pipeline import refine_rgbd

cameras = o3d.io.read_pinhole_camera_trajectory("RGBD/trajectory.json")
pairs = [[o3d.io.read_image(f"RGBD/{part}/{k:06}.png") for part in ("color", "depth")] for k in range(5)]
pairs = refine_rgbd(pairs, cameras)                           # the only new line; the loop stays the tutorial's
tsdf = o3d.pipelines.integration
volume = tsdf.UniformTSDFVolume(2.0, 100, 0.08, tsdf.TSDFVolumeColorType.RGB8, [-1.0] * 3)
for (color, depth), camera in zip(pairs, cameras.parameters):
    frame = o3d.geometry.RGBDImage.create_from_color_and_depth(color, depth, 1000.0, 4.0, False)
    volume.integrate(frame, camera.intrinsic, camera.extrinsic)
o3d.io.write_triangle_mesh("fine.ply", volume.extract_triangle_mesh())
