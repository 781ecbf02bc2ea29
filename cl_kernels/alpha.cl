// The paper's blend: exact front-to-back compositing without a global sort (method section 4).
//
//   link_bins            each Gaussian joins the list of the one-pixel bin that its mean falls into, and leaves its
//                        alpha for each of the PLACES pixels around that bin
//   composite_alpha      per context pixel: gather the few bins around, sorted, and composite
//   composite_alpha_vjp  the same lists again, back to front without division; dL/dalpha takes the place of alpha
//   gather_alpha         per Gaussian: from the dL/dalpha in its places to dL/dd
//
// Each pair of a Gaussian and a pixel has a place of its own, so that no two work-items ever write to the same one.
// A work-item keeps the SLOTS nearest candidates sorted by (z, index) in local memory. More are worked off in chunks,
// each one the next SLOTS behind the last; at most the MAX_PARTICIPANTS nearest take part.
#include "splat.clh"

#define MAX_PARTICIPANTS 128
#define MAX_CHUNKS ((MAX_PARTICIPANTS + SLOTS - 1) / SLOTS)
#define SIDE (2 * REACH + 1)
#define PLACES (SIDE * SIDE)
#define GROUP (LIST_GROUP_W * LIST_GROUP_H)
#define IN_GROUPS __attribute__((reqd_work_group_size(LIST_GROUP_W, LIST_GROUP_H, 1)))

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

// What a pixel finds around it: `heads` of its lowest bin on, rows of `stride` bins; planes of `count` alphas.
typedef struct {
    __global const int *heads;
    __global const int2 *links;
    __global float *alphas;
    int stride, count;
} Around;

Around look_around(__global const int *heads, __global const int2 *links, __global float *alphas, int count,
                   int column, int row, int width)
{
    Around a;
    a.heads = heads + row * (width + SIDE) + column;
    a.links = links;
    a.alphas = alphas;
    a.stride = width + SIDE;
    a.count = count;
    return a;
}

// A slot holds depth bits, pixel index, bits of alpha, and the plane that alpha came from.
ulong key_of(uint4 slot)
{
    return ((ulong)slot.x << 32) | slot.y;
}

// Put a candidate where it belongs in a list of `held`; the last one falls out of a full list.
void insert(__local uint4 *list, int held, uint4 slot)
{
    const ulong key = key_of(slot);
    int k = held;
    if (k == SLOTS) {
        if (key >= key_of(list[--k * GROUP]))
            return;
    }
    while (k > 0) {
        const uint4 before = list[(k - 1) * GROUP];
        if (key_of(before) <= key)
            break;
        list[k-- * GROUP] = before;
    }
    list[k * GROUP] = slot;
}

// Sort the SLOTS nearest candidates behind `behind` into the list; returns how many there are in all.
int gather(const Around a, ulong behind, bool first, __local uint4 *list)
{
    int seen = 0;
    for (int by = 0; by < SIDE; ++by) {
        int chains[SIDE];                  // of a row of bins at a time, so that their loads overlap
#pragma unroll
        for (int bx = 0; bx < SIDE; ++bx)
            chains[bx] = a.heads[by * a.stride + bx];
        int2 links[SIDE];
        float alphas[SIDE];
#pragma unroll
        for (int bx = 0; bx < SIDE; ++bx) {
            const int place = PLACES - 1 - by * SIDE - bx, i = max(chains[bx], 0);
            links[bx] = chains[bx] >= 0 ? a.links[i] : (int2)(-1, 0);
            alphas[bx] = chains[bx] >= 0 ? a.alphas[place * a.count + i] : 0.0f;
        }
#pragma unroll
        for (int bx = 0; bx < SIDE; ++bx) {
            const int place = PLACES - 1 - by * SIDE - bx;
            int i = chains[bx];
            int2 link = links[bx];
            float alpha = alphas[bx];
            while (i >= 0) {
                const uint4 slot = (uint4)((uint)link.y, (uint)i, as_uint(alpha), (uint)place);
                if (alpha != 0.0f && (first || key_of(slot) > behind)) {
                    insert(list, min(seen, SLOTS), slot);
                    ++seen;
                }
                i = link.x;
                if (i >= 0) {
                    link = a.links[i];
                    alpha = a.alphas[place * a.count + i];
                }
            }
        }
    }
    return seen;
}

// How many of the first `held` take part: none behind the depth threshold, which the first visible one sets. `limit`
// is carried from chunk to chunk.
int participants(__local const uint4 *list, int held, float threshold, float relative, float *limit)
{
#ifdef OCCLUSION
    for (int k = 0; k < held; ++k) {
        const uint4 slot = list[k * GROUP];
        const float z = as_float(slot.x);
        if (isinf(*limit) && as_float(slot.z) > ALPHA_SEEN)
            *limit = depth_limit(z, threshold, relative);
        if (z > *limit)
            return k;
    }
#endif
    return held;
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
    for (int taken = 0; taken < MAX_PARTICIPANTS; taken += SLOTS) {
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
