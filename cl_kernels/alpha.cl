// The paper's blend: exact front-to-back compositing without a global sort (method section 4).
//
//   link_bins            each Gaussian joins the list of the one-pixel bin that its mean falls into, and leaves its
//                        alpha for each of the PLACES pixels around that bin
//   composite_alpha      per context pixel: gather the few bins around, sorted, and composite
//   composite_alpha_vjp  the same lists again, back to front without division; dL/dalpha takes the place of alpha
//   gather_alpha         per Gaussian: from the dL/dalpha in its places to dL/dd
//
// Each pair of a Gaussian and a pixel has a place of its own, so that no two work-items ever write to the same one.
// few.clh serves the pixels with few candidates, which are nearly all of them; lists.clh the others. Both give the same
// order, and so the same numbers.
#include "few.clh"
#include "lists.clh"

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

__kernel IN_GROUPS
void composite_alpha(__global const uchar4 *target_photo, __global const float *exposure, int view,
                     __global const int *heads, __global const int2 *links, __global float *alphas, int count, int width, int height, float threshold, float relative,
                     __global float *rendered)
{
    __local uint4 lists[SLOTS * GROUP];
    __local uint4 *list = lists + get_local_id(1) * LIST_GROUP_W + get_local_id(0);
    const int column = get_global_id(0), row = get_global_id(1);
    if (column >= width || row >= height)
        return;
    const Around around = look_around(heads, links, alphas, count, column, row, width);
    color_t color = 0.0f;
    float transmittance = 1.0f, limit = INFINITY;
    ulong behind = 0;
#if REACH == 1
    Few few;
    const bool done = gather_few(around, &few);
    if (done)
        transmittance = blend_few(&few, target_photo, exposure, view, threshold, relative, &color);
#else
    const bool done = false;
#endif
    for (int taken = 0; !done && taken < MAX_PARTICIPANTS; taken += SLOTS) {
        const int seen = gather(around, behind, taken == 0, list);
        const int held = min(min(seen, SLOTS), MAX_PARTICIPANTS - taken);
        const int kept = participants(list, held, threshold, relative, &limit);
        for (int k = 0; k < kept; ++k) {
            const uint4 slot = list[k * GROUP];
            const float alpha = as_float(slot.z);
            color += exposed_color(target_photo[slot.y], exposure, view) * (alpha * transmittance);
            transmittance *= 1.0f - alpha;
        }
        if (kept < SLOTS || seen <= SLOTS)
            break;
        behind = key_of(list[(SLOTS - 1) * GROUP]);
    }
    const int pixel = row * width + column;
#ifdef GREY
    vstore2((float2)(color, 1.0f - transmittance), pixel, rendered);
#else
    vstore4((float4)(color, 1.0f - transmittance), pixel, rendered);
#endif
}

// Those behind the last participant pass nothing back.
void clear_behind(const Around a, ulong last, bool none)
{
    for (int b = 0; b < PLACES; ++b)
        for (int i = a.heads[b / SIDE * a.stride + b % SIDE]; i >= 0; i = a.links[i].x)
            if (none || (((ulong)(uint)a.links[i].y << 32) | (uint)i) > last)
                a.alphas[(PLACES - 1 - b) * a.count + i] = 0.0f;
}

// dL/dalpha of the first `kept`, back to front, to their places. `behind_color`, g . B_k, and `behind_open`, the product
// of 1 - alpha, are what lies behind them; carried from chunk to chunk.
void pass_back(const Around a, __local uint4 *list, int kept, float transmittance, __global const uchar4 *target_photo,
               __global const float *exposure, int view, color_t v_color, float v_coverage, float *behind_color, float *behind_open)
{
    for (int k = 0; k < kept; ++k) {           // T_k takes the place of the depth
        const float alpha = as_float(list[k * GROUP].z);
        list[k * GROUP].x = as_uint(transmittance);
        transmittance *= 1.0f - alpha;
    }
    for (int k = kept - 1; k >= 0; --k) {
        const uint4 slot = list[k * GROUP];
        const float alpha = as_float(slot.z), own = dot(v_color, exposed_color(target_photo[slot.y], exposure, view));
        a.alphas[(int)slot.w * a.count + (int)slot.y] =
            as_float(slot.x) * (own - *behind_color + v_coverage * *behind_open);
        *behind_color = alpha * own + (1.0f - alpha) * *behind_color;
        *behind_open *= 1.0f - alpha;
    }
}

__kernel IN_GROUPS
void composite_alpha_vjp(__global const uchar4 *target_photo, __global const float *exposure, int view,
                         __global const int *heads, __global const int2 *links, __global float *alphas, int count, int width, int height, float threshold, float relative,
                         __global const float *upstream)
{
    __local uint4 lists[SLOTS * GROUP];
    __local uint4 *list = lists + get_local_id(1) * LIST_GROUP_W + get_local_id(0);
    const int column = get_global_id(0), row = get_global_id(1);
    if (column >= width || row >= height)
        return;
    const int pixel = row * width + column;
    const Around around = look_around(heads, links, alphas, count, column, row, width);
#ifdef GREY
    const float2 up = vload2(pixel, upstream);
    const color_t v_color = up.x;
    const float v_coverage = up.y;
#else
    const float4 up = vload4(pixel, upstream);
    const color_t v_color = up.xyz;
    const float v_coverage = up.w;
#endif
#if REACH == 1
    Few few;
    if (gather_few(around, &few)) {
        pass_back_few(around, &few, target_photo, exposure, view, threshold, relative, v_color, v_coverage);
        return;
    }
#endif
    // forward over the chunks: where each one starts, the transmittance in front of it
    float in_front[MAX_CHUNKS], limit = INFINITY, transmittance = 1.0f;
    ulong starts[MAX_CHUNKS], behind = 0, last = 0;
    int chunk = 0, seen, kept, all = 0, taking_part = 0;
    for (;; ++chunk) {
        seen = gather(around, behind, chunk == 0, list);
        all = chunk == 0 ? seen : all;
        kept = participants(list, min(min(seen, SLOTS), MAX_PARTICIPANTS - chunk * SLOTS), threshold, relative, &limit);
        taking_part += kept;
        last = kept ? key_of(list[(kept - 1) * GROUP]) : behind;
        if (kept < SLOTS || seen <= SLOTS || chunk + 1 == MAX_CHUNKS)
            break;
        in_front[chunk] = transmittance;
        starts[chunk] = behind;
        for (int k = 0; k < SLOTS; ++k)
            transmittance *= 1.0f - as_float(list[k * GROUP].z);
        behind = last;
    }
    float behind_color = 0.0f, behind_open = 1.0f;
    pass_back(around, list, kept, transmittance, target_photo, exposure, view, v_color, v_coverage, &behind_color, &behind_open);
    while (chunk-- > 0) {
        gather(around, starts[chunk], chunk == 0, list);
        pass_back(around, list, SLOTS, in_front[chunk], target_photo, exposure, view, v_color, v_coverage, &behind_color, &behind_open);
    }
    if (taking_part < all)
        clear_behind(around, last, taking_part == 0);
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
