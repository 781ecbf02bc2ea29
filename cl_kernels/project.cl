// Per-Gaussian passes over the target that need only the projection (method section 3).
#include "splat.clh"

// With many lanes a look before the atomic saves most of them; on a GPU it is one more trip to memory.
void lower(__global volatile uint *place, uint key)
{
#if !ONE_PIXEL
    if (*place <= key)
        return;
#endif
    atomic_min(place, key);
}

__kernel void nearest(__global const float *depth, __constant float *cameras, int view, float low_pass,
                      __global volatile uint *z_first)
{
    const Camera target = load_camera(cameras, 0), context = load_camera(cameras, view);
    int column;
    const Gaussians g = load_gaussians(depth, target, context, get_global_id(0), get_global_id(1), low_pass, &column);
    if (!ANY(g.own))
        return;
    float z[COLUMNS];
    STORE_COLUMNS(g.splat.z, z);
    // without an exponential a pair
    const columns_t visible = 2.0f / LOG2_E * log2(g.splat.opacity * (1.0f / ALPHA_SEEN));
    EACH_PLACE(u, v) {
        const Reach r = reach_pixel(&g, context, u, v);
        if (!ANY(r.reached))
            continue;
        int pixel[COLUMNS], seen[COLUMNS];
        STORE_COLUMNS(r.pixel, pixel);
        STORE_COLUMNS(r.reached & (falloff(g.splat, r.dx, r.dy) < visible), seen);
        for (int k = 0; k < COLUMNS; ++k)
            if (seen[k])
                lower(&z_first[pixel[k]], depth_key(z[k]));
    }
}

// Which context pixels the initial depth reaches.
__kernel void mark_seen(__global const float *depth, __constant float *cameras, int view,
                        __global volatile uint *seen)              // [H' W' / 32] a bit a pixel
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
