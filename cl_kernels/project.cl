// Per-Gaussian passes over the target that need only the projection (method section 3).
#include "splat.clh"

// Twice the logarithm to base 2 down to which an opacity is seen: without an exponential a pair.
columns_t visible_falloff(const Splat s)
{
    return 2.0f / LOG2_E * log2(s.opacity * (1.0f / ALPHA_SEEN));
}

__kernel void nearest(__global const float *depth, __constant float *cameras, int view, float radius_threshold,
                      float low_pass, __global const int *row_ranges, __global volatile uint *z_first)
{
    const Camera target = load_camera(cameras, 0), context = load_camera(cameras, view);
    int column;
#if ONE_PIXEL
    const Gaussians g = load_gaussians(depth, target, context, get_global_id(0), get_global_id(1),
                                       radius_threshold, low_pass, &column);
    if (!g.own)
        return;
    const float visible = visible_falloff(g.splat);
    EACH_PLACE(u, v) {
        const Reach r = reach_pixel(&g, context.width, 0, context.height, u, v);
        if (r.reached && falloff(g.splat, r.dx, r.dy) < visible)
            atomic_min(&z_first[r.pixel], as_uint(g.splat.z));       // positive: bits sort as depths do
    }
#else
    const Strip strip = own_strip(context);
    EACH_IN_STRIP(item, row, row_ranges, strip, target, BLOCKS_ACROSS(target)) {
        mask_t pixels[PLACES];
        columns_t z[PLACES];
        const Gaussians g = load_gaussians(depth, target, context, item, row, radius_threshold, low_pass, &column);
        if (!ANY(g.own & (g.y < strip.to) & (g.y + SPAN > strip.from)))
            continue;
        const columns_t visible = visible_falloff(g.splat);
        EACH_PLACE(u, v) {
            const Reach r = reach_pixel(&g, context.width, strip.from, strip.to, u, v);
            const mask_t seen = r.reached & (falloff(g.splat, r.dx, r.dy) < visible);
            z[v * SPAN + u] = select((columns_t)INFINITY, g.splat.z, seen);
            pixels[v * SPAN + u] = r.pixel;
        }
        for (int k = 0; k < COLUMNS; ++k)
            UNROLL_SPAN for (int place = 0; place < PLACES; ++place) {
                __global float *first = (__global float *)z_first + LANE(int, pixels[place], k);
                const float own = LANE(float, z[place], k);
                *first = own < *first ? own : *first;
            }
    }
#endif
}

#if !ONE_PIXEL
// The rows of the context image that the Gaussians of each block reach, whatever their depths between its nearest and
// its farthest: the projected corners of that part of space enclose all of it.
__kernel void find_row_ranges(__global const float *depth, __constant float *cameras, int view,
                              float radius_threshold,
                              __global int *row_ranges)            // [blocks, first and last], none where last < first
{
    const Camera target = load_camera(cameras, 0), context = load_camera(cameras, view);
    const int left = get_global_id(0) * BLOCK_W, top = get_global_id(1) * BLOCK_H;
    const int right = min(left + BLOCK_W, target.width) - 1, bottom = min(top + BLOCK_H, target.height) - 1;
    columns_t near = INFINITY, far = ZERO;
    for (int y = top; y <= bottom; ++y)
        for (int x = left; x <= right; x += COLUMNS) {
            const columns_t d = LOAD_COLUMNS(depth + y * target.width + min(x, target.width - COLUMNS));
            near = fmin(near, select((columns_t)INFINITY, d, d > 0.0f));
            far = fmax(far, d);
        }
    float ends[2][COLUMNS], first = INFINITY, last = -INFINITY;
    STORE_COLUMNS(near, ends[0]);
    STORE_COLUMNS(far, ends[1]);
    for (int k = 1; k < COLUMNS; ++k) {
        ends[0][0] = fmin(ends[0][0], ends[0][k]);
        ends[1][0] = fmax(ends[1][0], ends[1][k]);
    }
    for (int corner = 0; corner < 8 && ends[1][0] > 0.0f; ++corner) {
        const float3 m = project_mean(target, context, corner & 1 ? left : right, corner & 2 ? top : bottom,
                                      ends[corner >> 2][0]);
        first = m.z > NEAR ? fmin(first, m.y) : -INFINITY;
        last = m.z > NEAR ? fmax(last, m.y) : INFINITY;
    }
    const int b = get_global_id(1) * BLOCKS_ACROSS(target) + get_global_id(0);
    row_ranges[2 * b] = (int)clamp(floor(first - radius_threshold) - 1.0f, -1.0f, 1e9f);
    row_ranges[2 * b + 1] = (int)clamp(ceil(last + radius_threshold) + 1.0f, -1.0f, 1e9f);
}
#endif
