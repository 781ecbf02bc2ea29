from pathlib import Path

import pagas_cl
from pagas_cl.refine import refine_views
from pagas_cl.scene.depthmap import find_depth, load_depth, save_depth

# MVSAnywhere's 640x480 depth, COLMAP's stereo/depth_maps/*.geometric.bin, .pfm, .npy, 16-bit .png (with scale=)
views = pagas_cl.read_scene("SCENE").views
files = [find_depth("DEPTH", view.name) for view in views]
depths = [f and load_depth(f, (v.camera.width, v.camera.height)) for f, v in zip(files, views)]
for result in refine_views(views, depths):      # of the views that have a depth map
    save_depth(f"refined/{Path(result.name).stem}.npz", result.depth)
