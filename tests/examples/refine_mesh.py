import open3d as o3d
import pagas_cl

scene = pagas_cl.read_scene("SCENE")
cameras = [view.camera for view in scene.views]
photos = [view.image for view in scene.views]
coarse = o3d.io.read_triangle_mesh("SCENE/mesh_coarse.ply")
fine = pagas_cl.refine_mesh(coarse, cameras, photos)
o3d.io.write_triangle_mesh("fine.ply", fine)
