import open3d as o3d
import pagas_cl
from pagas_cl.app.report import write_mesh_page

scene = pagas_cl.read_scene("SCENE")
coarse = o3d.io.read_triangle_mesh("SCENE/mesh_coarse.ply")
fine = pagas_cl.refine_mesh(coarse, scene.cameras, scene.images, output="displace", subdivide=2.0)
o3d.io.write_triangle_mesh("fine.ply", fine)   # the same mesh, edges of at most 2 pixels, vertices moved
write_mesh_page("meshes.html", coarse, fine)   # turns both in a browser, distance moved in colour
