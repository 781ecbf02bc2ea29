from pathlib import Path

import pagas_cl

# what a network, a phone or an RGB-D recording left; "DA3": an output of Depth Anything 3
scene = pagas_cl.read_scene("DA3")
scales = pagas_cl.align_depth_scales(scene.views, scene.depths)
print(*scales.said, sep="\n")        # "depth maps disagreed by 9.3% ...; factors of 0.831 to 1.189 and shifts ..."
for result in pagas_cl.refine_views(scene.views, scales.apply(scene.depths)):
    pagas_cl.save_depth(f"refined/{Path(result.name).stem}.npz", result.depth)
