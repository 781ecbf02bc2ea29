import open3d as o3d
import pagas_cl

scene = pagas_cl.read_scene("SCENE")
coarse = o3d.io.read_triangle_mesh("SCENE/mesh_coarse.ply")
fine = pagas_cl.refine_mesh(coarse, scene.cameras, scene.images, masks=scene.masks)
o3d.io.write_triangle_mesh("fine.ply", fine)
