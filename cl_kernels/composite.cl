// Order-free blend (method section 4): scatter weights and weighted colours as whole numbers.
//
// sums holds, per context pixel, fixed-point [weight, red, green, blue] ([weight, grey] with GREY).
#include "splat.clh"

#ifdef INT64_ATOMICS
#pragma OPENCL EXTENSION cl_khr_int64_base_atomics : enable
// Two 32-bit fields in one addition: they are never negative and never overflow, so no carry passes between them.
void add_pair(__global volatile uint *pair, uint low, uint high)
{
    atom_add((__global volatile ulong *)pair, ((ulong)high << 32) | low);
}
#else
void add_pair(__global volatile uint *pair, uint low, uint high)
{
    atomic_add(&pair[0], low);
    atomic_add(&pair[1], high);
}
#endif

__kernel void splat_order_free(__global const float *depth, __global const uchar4 *target_photo,
                               __global const float *cameras, int view, float low_pass, float threshold,
                               float relative, __global const uint *z_first, __global const float *exposure,
                               __global volatile uint *sums)
{
    const Camera target = load_camera(cameras, 0), context = load_camera(cameras, view);
    int column;
    const int row = get_global_id(1);
    const Gaussians g = load_gaussians(depth, target, context, get_global_id(0), row, low_pass, &column);
    if (!ANY(g.own))
        return;
    columns_t color[CHANNELS];
    load_exposed(target_photo, row * target.width + column, exposure, view, color);
    for (int v = 0; v < SPAN; ++v)
        for (int u = 0; u < SPAN; ++u) {
            const Reach r = reach_pixel(&g, context, u, v);
            if (!ANY(r.reached))
                continue;
            int pixel[COLUMNS], taken[COLUMNS], parts[CHANNELS + 1][COLUMNS];
            STORE_COLUMNS(r.pixel, pixel);
            STORE_COLUMNS(taking_part(&g, r, z_first, threshold, relative), taken);
            const columns_t weight = fmin(raw_alpha(g.splat, r.dx, r.dy), ALPHA_MAX) * FIXED_ONE;
            STORE_COLUMNS(TO_WHOLE(weight + 0.5f), parts[0]);
            for (int c = 0; c < CHANNELS; ++c)
                STORE_COLUMNS(TO_WHOLE(weight * color[c] + 0.5f), parts[c + 1]);
            for (int k = 0; k < COLUMNS; ++k) {
                if (!taken[k])
                    continue;
                __global volatile uint *sum = sums + pixel[k] * (CHANNELS + 1);
                add_pair(sum, parts[0][k], parts[1][k]);
#ifndef GREY
                add_pair(sum + 2, parts[2][k], parts[3][k]);
#endif
            }
        }
}
