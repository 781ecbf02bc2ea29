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
                                 && x + u < context.width && y + v >= 0 && y + v < context.height;
            alphas[((v + REACH) * SIDE + u + REACH) * count + i] =
                reached ? fmin(raw_alpha(s, dx, dy), ALPHA_MAX) : 0.0f;
        }
    const int bin = (y + REACH) * (context.width + SIDE) + x + REACH;
    links[i] = (int2)(atomic_xchg(&heads[bin], i), as_int(s.z));
}

__kernel IN_GROUPS
void composite_alpha(__global const uchar4 *target_photo, __global const float *exposure, int view,
                     __global const int *heads, __global const int2 *links, __global float *alphas, int count,
                     int width, int height, float depth_threshold, float depth_relative, __global float *rendered)
{
    __local ulong lists[SLOTS * GROUP];
    EACH_PIXEL(column, row, i, width, height)
    __local ulong *list = lists + get_local_id(1) * LIST_GROUP_W + get_local_id(0);
    const Around around = {heads + row * (width + SIDE) + column, links, alphas, width + SIDE, count};
    color_t color = 0.0f;
    float transmittance = 1.0f, farthest = INFINITY;
    ulong behind = 0;
    for (int taken = 0; taken < MAX_PARTICIPANTS; taken += SLOTS) {
        const int seen = gather(around, behind, list);
        const int held = min(min(seen, SLOTS), MAX_PARTICIPANTS - taken);
        const int kept = participants(around, list, held, depth_threshold, depth_relative, &farthest);
        for (int from = 0; from < kept; from += BATCH) {
            float alpha[BATCH];
            uchar4 colors[BATCH];
            load_batch(around, list, from, kept, alpha);
            UNROLL for (int k = 0; k < BATCH; ++k)
                colors[k] = target_photo[INDEX(list[min(from + k, kept - 1) * GROUP])];
            UNROLL for (int k = 0; k < BATCH; ++k) {
                color += exposed_color(colors[k], exposure, view) * (alpha[k] * transmittance);
                transmittance *= 1.0f - alpha[k];
            }
        }
        if (kept < SLOTS || seen <= SLOTS)
            break;
        behind = list[(SLOTS - 1) * GROUP];
    }
    ((__global PAINT(float) *)rendered)[i] = (PAINT(float))(color, 1.0f - transmittance);
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
    const int item = get_local_id(1) * LIST_GROUP_W + get_local_id(0);
    __local ulong *list = lists + item;
    const Around around = {heads + row * (width + SIDE) + column, links, alphas, width + SIDE, count};
    const PAINT(float) up = ((__global const PAINT(float) *)v_rendered)[i];
#ifdef GREY
    const color_t v_color = up.x;
    const float v_coverage = up.y;
#else
    const color_t v_color = up.xyz;
    const float v_coverage = up.w;
#endif
    // forward over the chunks: where each one starts, the transmittance in front of it
    float in_front[MAX_CHUNKS], farthest = INFINITY, transmittance = 1.0f;
    ulong starts[MAX_CHUNKS], behind = 0, last = 0;
    int chunk = 0, seen, kept, all = 0, taking_part = 0;
    for (;; ++chunk) {
        seen = gather(around, behind, list);
        all = chunk == 0 ? seen : all;
        kept = participants(around, list, min(min(seen, SLOTS), MAX_PARTICIPANTS - chunk * SLOTS), depth_threshold,
                            depth_relative, &farthest);
        taking_part += kept;
        last = kept ? list[(kept - 1) * GROUP] : behind;
        if (kept < SLOTS || seen <= SLOTS || chunk + 1 == MAX_CHUNKS)
            break;
        in_front[chunk] = transmittance;
        starts[chunk] = behind;
        for (int k = 0; k < SLOTS; ++k)
            transmittance *= 1.0f - *alpha_of(around, list[k * GROUP]);
        behind = last;
    }
    float behind_color = 0.0f, behind_open = 1.0f;
    for (;;) {
        pass_back(around, list, held + item, kept, transmittance, target_photo, exposure, view, v_color, v_coverage,
                  &behind_color, &behind_open);
        if (chunk-- == 0)
            break;
        gather(around, starts[chunk], list);
        kept = SLOTS;
        transmittance = in_front[chunk];
    }
    if (taking_part == all)
        return;
    for (int b = 0; b < PLACES; ++b)             // those behind the last participant pass nothing back
        for (int k = around.heads[b / SIDE * around.stride + b % SIDE]; k >= 0; k = links[k].x)
            if (slot_of(links[k].y, k, PLACES - 1 - b) > last)
                alphas[(PLACES - 1 - b) * count + k] = 0.0f;
}

__kernel void gather_alpha(__global const float *depth, __constant float *cameras, int view, float radius_threshold,
                           float inverse_area, float low_pass, __global const float *alphas, __global float *gradient,
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
