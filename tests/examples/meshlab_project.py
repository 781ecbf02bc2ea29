from pathlib import Path
import numpy as np
import pagas_cl
from pagas_cl.scene.readers.meshlab import MeshLayer, write_project

scene = pagas_cl.read_scene("SCENE")                                 # any format
layer = MeshLayer("coarse", Path("SCENE/mesh_coarse.ply"), np.eye(4))
write_project("SCENE/scene.mlp", scene.views, [layer])               # opens in MeshLab, cameras to the last digit
again = pagas_cl.read_scene("SCENE/scene.mlp", "meshlab")            # no OpenGL; logs how CenterPx was read
