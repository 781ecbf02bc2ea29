import pymeshlab
from pagas_cl.filters.pymeshlab_step import register

register()
meshes = pymeshlab.MeshSet()
meshes.load_new_mesh("SCENE/mesh_coarse.ply")
meshes.meshing_remove_duplicate_vertices()
meshes.apply_pagas_depth_refinement("SCENE", context_views=5)
meshes.meshing_remove_connected_component_by_face_number(mincomponentsize=100)
meshes.save_current_mesh("fine.ply")
meshes.save_filter_script("all_three_steps.mlx")
