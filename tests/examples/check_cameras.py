import pagas_cl

scene = pagas_cl.read_scene("SCENE")
report = pagas_cl.check_cameras("SCENE/mesh_coarse.ply", scene.cameras, scene.images)
print(report.sentence)          # "5 of 5 cameras see the mesh, and the photos agree over it ..." or what mends them
print(report.half_pixel)
