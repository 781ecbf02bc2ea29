"""Data that comes in: cameras, photos, masks, meshes, depth maps, and the scenes that hold them.

This level has the types (camera, view, mesh, depthmap, images, lens) and what they share (names, npy_files,
sampling), and which views are compared (choice). Below:

    readers    scenes of other programs; table readers.FORMATS
    meshes     mesh files and meshes of other libraries; table meshes.files.FORMATS
    depth      depth maps in files, their unit and place in the photo; table depth.formats.FORMATS
    check      do cameras, mesh and photos fit together, and if not, what is wrong?
"""
