// The paper's blend: exact front-to-back compositing without a global sort (method section 4).
//
//   link_bins            each Gaussian joins the list of the one-pixel bin that its mean falls into, and leaves its
//                        alpha for each of the pixels around that bin
//   composite_alpha      per context pixel: gather the few bins around, sorted, and composite
//   composite_alpha_vjp  the same again, back to front without division; dL/dalpha takes the place of alpha
//   gather_alpha         per Gaussian: from the dL/dalpha in its places to dL/dd; leaves the bins empty
//
// Each pair of a Gaussian and a pixel has a place of its own, so that no two work-items ever write to the same one.
#include "lists.clh"

__kernel void link_bins(__global const float *depth, __constant float *cameras, int view, float radius_threshold,
                        float low_pass,
                        __global volatile int *heads,              // [H' + SIDE, W' + SIDE] Gaussian, -1 = none
                        __global int2 *links,                      // [H, W] next Gaussian, bits of z
                        __global float *alphas)                    // [PLACES, H, W]
{
    const Camera target = load_camera(cameras, 0), context = load_camera(cameras, view);
    EACH_PIXEL(column, row, i, target.width, target.height)
    const int count = target.width * target.height;
    Splat s;
    SplatDerivative dsplat_ddepth;
    if (!project_gaussian(target, context, column, row, depth[i], radius_threshold, low_pass, &s, &dsplat_ddepth))
        return;
    const int x = (int)floor(s.x), y = (int)floor(s.y);
    for (int v = -REACH; v <= REACH; ++v)
        for (int u = -REACH; u <= REACH; ++u) {
            const float dx = x + u + 0.5f - s.x, dy = y + v + 0.5f - s.y;
            const bool reached = dx * dx + dy * dy <= radius_threshold * radius_threshold && x + u >= 0
                                 && x + u < context.width
                                 && y + v >= 0 && y + v < context.height;
            alphas[((v + REACH) * SIDE + u + REACH) * count + i] =
                reached ? fmin(raw_alpha(s, dx, dy), ALPHA_MAX) : 0.0f;
        }
    const int bin = (y + REACH) * (context.width + SIDE) + x + REACH;
    links[i] = (int2)(atomic_xchg(&heads[bin], i), as_int(depth_key(s.z)));
}

__kernel IN_GROUPS
void composite_alpha(__global const uchar4 *target_photo, __global const float *exposure, int view,
                     __global const int *heads, __global const int2 *links,             // as link_bins has them
                     __global float *alphas, int count, int width, int height, float depth_threshold,
                     float depth_relative, __global float *rendered)    // [H', W', C and A]
{
    __local ulong lists[SLOTS * GROUP];
    EACH_PIXEL(column, row, i, width, height)
    blend(look_around(heads, links, alphas, count, column, row, width),
          lists + get_local_id(1) * LIST_GROUP_W + get_local_id(0), target_photo, exposure, view, depth_threshold,
          depth_relative, row * width + column, rendered);
}

__kernel IN_GROUPS
void composite_alpha_vjp(__global const uchar4 *target_photo, __global const float *exposure, int view,
                         __global const int *heads, __global const int2 *links,             // as link_bins has them
                         __global float *alphas, int count, int width, int height, float depth_threshold,
                         float depth_relative, __global const float *v_rendered)    // [H', W', dL/dC and dL/dA]
{
    __local ulong lists[SLOTS * GROUP];
    __local float held[SLOTS * GROUP];
    EACH_PIXEL(column, row, i, width, height)
    float v_coverage;
    const color_t v_color = load_v_rendered(v_rendered, row * width + column, &v_coverage);
    const int item = get_local_id(1) * LIST_GROUP_W + get_local_id(0);
    blend_vjp(look_around(heads, links, alphas, count, column, row, width), lists + item, held + item, target_photo,
              exposure, view, depth_threshold, depth_relative, v_color, v_coverage);
}

__kernel void gather_alpha(__global const float *depth, __constant float *cameras, int view, float radius_threshold,
                           float inverse_area, float low_pass,
                           __global const float *alphas,           // [PLACES, H, W] dL/dalpha
                           __global float *gradient,               // [H, W] N dL/dd is added
                           __global int *heads, int bins)
{
    const Camera target = load_camera(cameras, 0), context = load_camera(cameras, view);
    EACH_PIXEL(column, row, i, target.width, target.height)
    const int count = target.width * target.height;
    for (int bin = i; bin < bins; bin += count)
        heads[bin] = -1;
    Splat s;
    SplatDerivative dsplat_ddepth;
    if (!project_gaussian(target, context, column, row, depth[i], radius_threshold, low_pass, &s, &dsplat_ddepth))
        return;
    const int x = (int)floor(s.x), y = (int)floor(s.y);
    const LogSlope slope = log_slope(s, dsplat_ddepth);
    float sum = 0.0f;
    for (int v = -REACH; v <= REACH; ++v)
        for (int u = -REACH; u <= REACH; ++u) {
            const float v_alpha = alphas[((v + REACH) * SIDE + u + REACH) * count + i];
            const float dx = x + u + 0.5f - s.x, dy = y + v + 0.5f - s.y;
            sum += v_alpha * dalpha_ddepth(slope, dsplat_ddepth, dx, dy, raw_alpha(s, dx, dy), inverse_area);
        }
    gradient[i] += sum;
}
