import pagas_cl

for folder in ("NERFSTUDIO", "MVSNET", "NEUS", "BUNDLER", "RGBD"):
    scene = pagas_cl.read_scene(folder)        # found by looking; read_scene(folder, "neus") overrides
    print(scene.source, len(scene.views), scene.views[0].camera)
