import pagas_cl
import pyopencl
from pagas_cl.runtime.vendors import registered

with registered():                                       # the system's drivers, and Intel's from pip
    context = pyopencl.create_some_context(interactive=False)
device = pagas_cl.Device.of(pyopencl.CommandQueue(context))
scene = pagas_cl.read_scene("SCENE")
depths = [pagas_cl.load_depth(pagas_cl.find_depth("SCENE/depth_initial", view.name)) for view in scene.views]
results = pagas_cl.refine_views(scene.views, depths, preset="fast", device=device)
