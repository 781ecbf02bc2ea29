import pagas_cl

# what a network, a phone or an RGB-D recording left; "DA3": pagas-cl demo --format da3 --output DA3
scene = pagas_cl.read_scene("DA3")
together = pagas_cl.bring_together(scene.views, scene.depths)
print(*together.said, sep="\n")        # "depth maps disagreed by 9.3% ...; factors of 0.831 to 1.189 and shifts ..."
for view, result in zip(scene.views, pagas_cl.refine_views(scene.views, together.apply(scene.depths))):
    pagas_cl.save_depth(f"refined/{view.stem}.npz", result.depth)
