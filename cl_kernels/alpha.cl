// The paper's blend: exact front-to-back compositing without a global sort (method section 4).
//
//   link_bins            each Gaussian joins the list of the one-pixel bin that its mean falls into, and leaves its
//                        alpha for each of the pixels around that bin
//   composite_alpha      per context pixel: gather the few bins around, sorted, and composite
//   composite_alpha_vjp  the same again, back to front without division; dL/dalpha takes the place of alpha
//   gather_alpha         per Gaussian: from the dL/dalpha in its places to dL/dd
//
// Each pair of a Gaussian and a pixel has a place of its own, so that no two work-items ever write to the same one.
// Pixels with more candidates than few.clh holds are left to crowded.cl, which gives the same order.
#include "few.clh"

#define SIDE (2 * REACH + 1)

__kernel void link_bins(__global const float *depth, __global const float *cameras, int view, float radius,
                        float low_pass, __global volatile int *heads, __global int2 *links, __global float *alphas)
{
    const Camera target = load_camera(cameras, 0), context = load_camera(cameras, view);
    const int column = get_global_id(0), row = get_global_id(1);
    if (column >= target.width || row >= target.height)
        return;
    const int i = row * target.width + column, count = target.width * target.height;
    const float d = depth[i];
    Splat s;
    Motion motion;
    if (!(d > 0.0f) || !project_gaussian(target, context, column, row, d, radius, low_pass, &s, &motion))
        return;
    const int x = (int)floor(s.mean.x), y = (int)floor(s.mean.y);
    for (int v = -REACH; v <= REACH; ++v)
        for (int u = -REACH; u <= REACH; ++u) {
            const float2 delta = offset_from(s, x + u, y + v);
            const bool reached = dot(delta, delta) <= radius * radius && x + u >= 0 && x + u < context.width
                                 && y + v >= 0 && y + v < context.height;
            alphas[((v + REACH) * SIDE + u + REACH) * count + i] = reached ? fmin(raw_alpha(s, delta), ALPHA_MAX) : 0.0f;
        }
    const int bin = (y + REACH) * (context.width + SIDE) + x + REACH;
    links[i] = (int2)(atomic_xchg(&heads[bin], i), as_int(depth_key(s.z)));
}

__kernel IN_TILES
void composite_alpha(__global const uchar4 *target_photo, __global const float *exposure, int view,
                     __global int *heads, __global const int2 *links, __global float *alphas, __global int *crowded,
                     int count, int width, int height, float threshold, float relative, __global float *rendered)
{
    __local uint4 tile[2 * TILE_BINS];
    const int column = get_global_id(0), row = get_global_id(1), pixel = row * width + column;
    load_bins(heads, links, target_photo, width, height, tile);
    barrier(CLK_LOCAL_MEM_FENCE);
    if (column >= width || row >= height)
        return;
    __local const uint4 *bins = tile + get_local_id(1) * TILE_BINS_W + get_local_id(0);
    Few few;
    if (!gather_few(bins, alphas, count, &few)) {
        crowded[1 + atomic_inc(&heads[(width + SIDE) * (height + SIDE)])] = pixel;      // counts from -1
        return;
    }
    color_t color = 0.0f;
    float transmittance = 1.0f, limit = INFINITY;
#pragma unroll
    for (int k = 0; k < FEW; ++k) {
        const float alpha = few_alpha(&few, k, threshold, relative, &limit);
        if (alpha > 0.0f)
            color += few_color(few.key[k], bins, exposure, view) * (alpha * transmittance);
        transmittance *= 1.0f - alpha;
    }
    store_blend(color, 1.0f - transmittance, pixel, rendered);
}

__kernel IN_TILES
void composite_alpha_vjp(__global const uchar4 *target_photo, __global const float *exposure, int view,
                         __global const int *heads, __global const int2 *links, __global float *alphas, int count,
                         int width, int height, float threshold, float relative, __global const float *upstream)
{
    __local uint4 tile[2 * TILE_BINS];
    const int column = get_global_id(0), row = get_global_id(1), pixel = row * width + column;
    load_bins(heads, links, target_photo, width, height, tile);
    barrier(CLK_LOCAL_MEM_FENCE);
    if (column >= width || row >= height)
        return;
    __local const uint4 *bins = tile + get_local_id(1) * TILE_BINS_W + get_local_id(0);
    Few few;
    if (!gather_few(bins, alphas, count, &few))
        return;
    float v_coverage, alpha[FEW], open[FEW], own[FEW], transmittance = 1.0f, limit = INFINITY;
    const color_t v_color = load_upstream(upstream, pixel, &v_coverage);
#pragma unroll
    for (int k = 0; k < FEW; ++k) {
        alpha[k] = few_alpha(&few, k, threshold, relative, &limit);
        own[k] = 0.0f;
        if (alpha[k] > 0.0f)
            own[k] = dot(v_color, few_color(few.key[k], bins, exposure, view));
        open[k] = transmittance;
        transmittance *= 1.0f - alpha[k];
    }
    float behind_color = 0.0f, behind_open = 1.0f;
#pragma unroll
    for (int k = FEW - 1; k >= 0; --k) {
        if (few.key[k] != NO_KEY)
            *alpha_place(alphas, count, few_bin(few.key[k]), few_index(few.key[k])) =
                alpha[k] > 0.0f ? open[k] * (own[k] - behind_color + v_coverage * behind_open) : 0.0f;
        behind_color = alpha[k] * own[k] + (1.0f - alpha[k]) * behind_color;
        behind_open *= 1.0f - alpha[k];
    }
}

__kernel void gather_alpha(__global const float *depth, __global const float *cameras, int view, float radius,
                           float low_pass, __global const float *alphas, __global float *gradient)
{
    const Camera target = load_camera(cameras, 0), context = load_camera(cameras, view);
    const int column = get_global_id(0), row = get_global_id(1);
    if (column >= target.width || row >= target.height)
        return;
    const int i = row * target.width + column, count = target.width * target.height;
    const float d = depth[i];
    Splat s;
    Motion motion;
    if (!(d > 0.0f) || !project_gaussian(target, context, column, row, d, radius, low_pass, &s, &motion))
        return;
    const int x = (int)floor(s.mean.x), y = (int)floor(s.mean.y);
    float sum = 0.0f;
    for (int v = -REACH; v <= REACH; ++v)
        for (int u = -REACH; u <= REACH; ++u) {
            const float v_alpha = alphas[((v + REACH) * SIDE + u + REACH) * count + i];
            const float2 delta = offset_from(s, x + u, y + v);
            sum += v_alpha * alpha_motion(s, motion, delta, raw_alpha(s, delta));
        }
    gradient[i] += sum;
}
