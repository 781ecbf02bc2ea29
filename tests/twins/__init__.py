"""Float64 NumPy twins: the readable maths of the method, what the kernels are tested against.

Everything is in the target camera's frame with lengths divided by `scene_scale`, the median valid initial depth. Arrays
are row-major: target pixel i is row * width + column. A function `f_vjp` is the backward of `f`; `v_x` is the gradient
of the loss by x, of the shape of x; `x_d` is the derivative of x by the Gaussian's own depth d.
"""
