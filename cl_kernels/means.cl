// Passes over the target that need only where the means land, and none of the splatting's settings (method section 3).
#include "camera.clh"

__kernel void mark_seen(__global const float *depth, __constant float *cameras, int view, __global volatile uint *seen)
{
    const Camera target = load_camera(cameras, 0), context = load_camera(cameras, view);
    EACH_PIXEL(column, row, i, target.width, target.height)
    const float d = depth[i];
    if (!(d > 0.0f))
        return;
    const float3 m = project_mean(target, context, column, row, d);
    if (!(m.z > NEAR) || !in_image(context, m))
        return;
    const int pixel = (int)floor(m.y) * context.width + (int)floor(m.x);
    atomic_or(&seen[pixel >> 5], 1u << (pixel & 31));
}

// u = 1 / sqrt(mean |dm/dd|^2) over the context views that see the Gaussian; 0 where none does: such a pixel is fixed.
__kernel void find_depth_per_parallax(__global const float *depth, __constant float *cameras, int views,
                            __global float *depth_per_parallax)
{
    const Camera target = load_camera(cameras, 0);
    EACH_PIXEL(column, row, i, target.width, target.height)
    const float d = depth[i];
    float sum = 0.0f;
    int count = 0;
    for (int view = 1; view <= views && d > 0.0f; ++view) {
        const Camera context = load_camera(cameras, view);
        const float3 q = turned_ray(target, context, column, row), m = project_ray(context, q, d);
        if (!(m.z > NEAR) || !in_image(context, m))
            continue;
        const float inverse_z = 1.0f / m.z;
        const float2 v = dmean_ddepth(context, q) * (inverse_z * inverse_z);
        sum += dot(v, v);
        ++count;
    }
    const float mean = count ? sum / count : 0.0f;
    depth_per_parallax[i] = mean > 1e-12f ? rsqrt(mean) : 0.0f;
}
