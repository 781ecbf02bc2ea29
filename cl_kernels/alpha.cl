// The paper's blend: exact front-to-back compositing without a global sort (method section 4).
//
//   link_bins            each Gaussian joins the list of the one-pixel bin that its mean falls into
//   composite_alpha      per context pixel: gather the few bins around, sort in registers, composite
//   composite_alpha_vjp  the same lists again, back to front without division; sums into whole numbers
//
// A pixel holds SLOTS candidates sorted by (z, index) in registers. More than SLOTS are worked off in chunks, each
// chunk being the next SLOTS behind the last; at most MAX_CHUNKS * SLOTS = 128 of the nearest take part.
#include "splat.clh"

#define MAX_PARTICIPANTS 128
#define MAX_CHUNKS (MAX_PARTICIPANTS / SLOTS)
#define LAST_KEY 0xffffffffffffffffUL

typedef struct {
    ulong key[SLOTS];        // depth bits, then pixel index: ties never depend on the order of arrival
    float alpha[SLOTS];
} Chunk;

#ifdef INT64_ATOMICS
#pragma OPENCL EXTENSION cl_khr_int64_base_atomics : enable
void add_fixed(__global volatile long *sum, long value)
{
    atom_add(sum, value);
}
#else
// 64 bits as two 32-bit additions; the carry is exact whatever the order of arrival.
void add_fixed(__global volatile long *sum, long value)
{
    __global volatile uint *words = (__global volatile uint *)sum;
    const uint low = (uint)value, old = atomic_add(&words[0], low);
    atomic_add(&words[1], (uint)((ulong)value >> 32) + (old + low < old ? 1u : 0u));
}
#endif

__kernel void link_bins(__global const float *depth, __global const float *cameras, int view, float radius,
                        float low_pass, __global volatile int *heads, __global int *next, __global float *records)
{
    const Camera target = load_camera(cameras, 0), context = load_camera(cameras, view);
    const int column = get_global_id(0), row = get_global_id(1);
    if (column >= target.width || row >= target.height)
        return;
    const int i = row * target.width + column;
    const float d = depth[i];
    Splat s;
    Motion motion;
    if (!(d > 0.0f) || !project_gaussian(target, context, column, row, d, radius, low_pass, &s, &motion))
        return;
    const int x = (int)floor(s.mean.x) + REACH, y = (int)floor(s.mean.y) + REACH;
    const int bin = y * (context.width + 2 * REACH + 1) + x;
    vstore8((float8)(s.mean.x, s.mean.y, s.z, s.opacity, s.kxx, s.kxy, s.kyy, 0.0f), i, records);
    next[i] = atomic_xchg(&heads[bin], i);
}

Splat load_splat(__global const float *records, int i)
{
    const float8 r = vload8(i, records);
    Splat s;
    s.mean = r.s01;
    s.z = r.s2;
    s.opacity = r.s3;
    s.kxx = r.s4;
    s.kxy = r.s5;
    s.kyy = r.s6;
    return s;
}

// The SLOTS nearest candidates behind `behind`, in order. Returns how many there are.
int gather_chunk(__global const int *heads, __global const int *next, __global const float *records, int column,
                 int row, int bins_wide, float radius, ulong behind, bool first, Chunk *chunk)
{
    int count = 0;
    for (int k = 0; k < SLOTS; ++k) {
        chunk->key[k] = LAST_KEY;
        chunk->alpha[k] = 0.0f;
    }
    for (int by = 0; by <= 2 * REACH; ++by)
        for (int bx = 0; bx <= 2 * REACH; ++bx)
            for (int i = heads[(row + by) * bins_wide + column + bx]; i >= 0; i = next[i]) {
                const Splat s = load_splat(records, i);
                const float2 delta = offset_from(s, column, row);
                if (!(dot(delta, delta) <= radius * radius))
                    continue;
                ulong key = ((ulong)depth_key(s.z) << 32) | (uint)i;
                if (!first && key <= behind)
                    continue;
                float alpha = fmin(raw_alpha(s, delta), ALPHA_MAX);
                ++count;
                for (int k = 0; k < SLOTS; ++k) {
                    const bool before = key < chunk->key[k];
                    const ulong held = chunk->key[k];
                    const float held_alpha = chunk->alpha[k];
                    chunk->key[k] = before ? key : held;
                    chunk->alpha[k] = before ? alpha : held_alpha;
                    key = before ? held : key;
                    alpha = before ? held_alpha : alpha;
                }
            }
    return min(count, SLOTS);
}

float key_depth(ulong key)
{
    return as_float((uint)(key >> 32));
}

// Cut the chunk off behind the depth threshold; `limit` is carried from chunk to chunk (infinite until z_first).
int cut_behind(Chunk *chunk, int count, float threshold, float relative, float *limit)
{
#ifdef OCCLUSION
    int kept = 0;
    for (int k = 0; k < SLOTS; ++k) {
        if (k >= count)
            break;
        const float z = key_depth(chunk->key[k]);
        if (isinf(*limit) && chunk->alpha[k] > ALPHA_SEEN)
            *limit = depth_limit(z, threshold, relative);
        kept += z <= *limit;
    }
    return kept;
#else
    return count;
#endif
}

__kernel void composite_alpha(__global const float *records, __global const uchar4 *target_photo,
                              __global const int *heads, __global const int *next, int width, int height,
                              float radius, float threshold, float relative, __global float *rendered)
{
    const int column = get_global_id(0), row = get_global_id(1);
    if (column >= width || row >= height)
        return;
    const int bins_wide = width + 2 * REACH + 1;
    color_t color = 0.0f;
    float transmittance = 1.0f, limit = INFINITY;
    ulong behind = 0;
    Chunk chunk;
    for (int pass = 0; pass < MAX_CHUNKS; ++pass) {
        const int count = gather_chunk(heads, next, records, column, row, bins_wide, radius, behind, pass == 0, &chunk);
        const int kept = cut_behind(&chunk, count, threshold, relative, &limit);
        for (int k = 0; k < SLOTS; ++k)
            if (k < kept) {
                const uint i = (uint)chunk.key[k];
                color += color_of(target_photo[i]) * (chunk.alpha[k] * transmittance);
                transmittance *= 1.0f - chunk.alpha[k];
            }
        if (kept < SLOTS)
            break;
        behind = chunk.key[SLOTS - 1];
    }
    const int pixel = row * width + column;
#ifdef GREY
    vstore2((float2)(color, 1.0f - transmittance), pixel, rendered);
#else
    vstore4((float4)(color, 1.0f - transmittance), pixel, rendered);
#endif
}

// dL/dd of one participant, given dL/dalpha.
void pass_back(__global const float *depth, const Camera target, const Camera context, uint i, int column, int row,
               float radius, float low_pass, float v_alpha, __global volatile long *gradient)
{
    Splat splat;
    Motion motion;
    const int u = (int)i % target.width, v = (int)i / target.width;
    if (!project_gaussian(target, context, u, v, depth[i], radius, low_pass, &splat, &motion))
        return;
    const float2 delta = offset_from(splat, column, row);
    const float value = v_alpha * alpha_motion(splat, motion, delta, raw_alpha(splat, delta));
    add_fixed(&gradient[i], convert_long_rte(clamp(value, -1e9f, 1e9f) * GRADIENT_ONE));
}

__kernel void composite_alpha_vjp(__global const float *depth, __global const float *records,
                                  __global const uchar4 *target_photo, __global const float *cameras, int view,
                                  __global const int *heads, __global const int *next, float radius, float low_pass,
                                  float threshold, float relative, __global const float *upstream,
                                  __global volatile long *gradient)
{
    const Camera target = load_camera(cameras, 0), context = load_camera(cameras, view);
    const int column = get_global_id(0), row = get_global_id(1);
    if (column >= context.width || row >= context.height)
        return;
    const int pixel = row * context.width + column, bins_wide = context.width + 2 * REACH + 1;
#ifdef GREY
    const float2 up = vload2(pixel, upstream);
    const color_t v_color = up.x;
    const float v_coverage = up.y;
#else
    const float4 up = vload4(pixel, upstream);
    const color_t v_color = up.xyz;
    const float v_coverage = up.w;
#endif
    // forward over the chunks: transmittance in front of each, how many it holds, where it starts
    float in_front[MAX_CHUNKS], limit = INFINITY, transmittance = 1.0f;
    int held[MAX_CHUNKS], chunks = 0;
    ulong starts[MAX_CHUNKS], behind = 0;
    Chunk chunk;
    for (int pass = 0; pass < MAX_CHUNKS; ++pass) {
        const int count = gather_chunk(heads, next, records, column, row, bins_wide, radius, behind, pass == 0, &chunk);
        const int kept = cut_behind(&chunk, count, threshold, relative, &limit);
        in_front[pass] = transmittance;
        starts[pass] = behind;
        held[pass] = kept;
        chunks = pass + 1;
        if (kept < SLOTS)
            break;
        for (int k = 0; k < SLOTS; ++k)
            transmittance *= 1.0f - chunk.alpha[k];
        behind = chunk.key[SLOTS - 1];
    }
    color_t behind_color = 0.0f;         // B_k: what is composited behind k
    float behind_open = 1.0f;            // product of (1 - alpha) behind k
    for (int pass = chunks - 1; pass >= 0; --pass) {
        if (pass != chunks - 1)
            gather_chunk(heads, next, records, column, row, bins_wide, radius, starts[pass], pass == 0, &chunk);
        float open[SLOTS], t = in_front[pass];
        for (int k = 0; k < SLOTS; ++k) {
            open[k] = t;
            t *= k < held[pass] ? 1.0f - chunk.alpha[k] : 1.0f;
        }
        for (int k = SLOTS - 1; k >= 0; --k)
            if (k < held[pass]) {
                const uint i = (uint)chunk.key[k];
                const color_t color = color_of(target_photo[i]);
                const float v_alpha = open[k] * (dot(v_color, color - behind_color) + v_coverage * behind_open);
                pass_back(depth, target, context, i, column, row, radius, low_pass, v_alpha, gradient);
                behind_color = chunk.alpha[k] * color + (1.0f - chunk.alpha[k]) * behind_color;
                behind_open *= 1.0f - chunk.alpha[k];
            }
    }
}

// Whole-number sums to the gradient that step.cl reads.
__kernel void collect_gradient(__global long *fixed, int count, __global float *gradient)
{
    const int i = get_global_id(0);
    if (i >= count)
        return;
    gradient[i] += fixed[i] * (1.0f / GRADIENT_ONE);
    fixed[i] = 0;
}
