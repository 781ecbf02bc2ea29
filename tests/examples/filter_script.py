import pymeshlab
from pagas_cl.filters.filter_script import run_script

meshes = pymeshlab.MeshSet()
meshes.load_new_mesh("SCENE/mesh_coarse.ply")
run_script(meshes, "mixed.mlx", "SCENE")      # or: pagas-cl script mixed.mlx SCENE --mesh ... --output fine.ply
meshes.save_current_mesh("fine.ply")
