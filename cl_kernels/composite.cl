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
                               __global const float *cameras, int view, float radius, float low_pass,
                               float threshold, float relative, __global const uint *z_first,
                               __global const float *exposure, __global volatile uint *sums)
{
    const Camera target = load_camera(cameras, 0), context = load_camera(cameras, view);
    const int column = get_global_id(0), row = get_global_id(1);
    if (column >= target.width || row >= target.height)
        return;
    const int i = row * target.width + column;
    const float d = depth[i];
    Splat splat;
    Motion motion;
    if (!(d > 0.0f) || !project_gaussian(target, context, column, row, d, radius, low_pass, &splat, &motion))
        return;
    const Footprint f = footprint(splat.mean, radius, context.width, context.height);
    const color_t color = exposed_color(target_photo[i], exposure, view) * FIXED_ONE;
    for (int y = f.y0; y <= f.y1; ++y)
        for (int x = f.x0; x <= f.x1; ++x) {
            const int pixel = y * context.width + x;
            const float2 delta = offset_from(splat, x, y);
            if (!(dot(delta, delta) <= radius * radius))
                continue;
#ifdef OCCLUSION
            if (splat.z > depth_limit(as_float(z_first[pixel]), threshold, relative))
                continue;
#endif
            const float alpha = fmin(raw_alpha(splat, delta), ALPHA_MAX);
            __global volatile uint *sum = sums + pixel * (CHANNELS + 1);
#ifdef GREY
            add_pair(sum, (uint)(alpha * FIXED_ONE + 0.5f), (uint)(alpha * color + 0.5f));
#else
            add_pair(sum, (uint)(alpha * FIXED_ONE + 0.5f), (uint)(alpha * color.x + 0.5f));
            add_pair(sum + 2, (uint)(alpha * color.y + 0.5f), (uint)(alpha * color.z + 0.5f));
#endif
        }
}
