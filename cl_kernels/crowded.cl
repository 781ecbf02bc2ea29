// The paper's blend where candidates are many, and for reaches beyond the next bin: composite_alpha and
// composite_alpha_vjp over lists in local memory (method section 4). With REACH 1 these pixels are found by
// composite_alpha; otherwise they are all pixels.
#include "lists.clh"

// Pixel number k of those to be done here, or -1: their number less one is the entry of `heads` behind the last bin.
int crowded_pixel(int k, __global const int *heads, __global const int *crowded, int width, int height)
{
#if REACH == 1
    return k <= heads[(width + SIDE) * (height + SIDE)] ? crowded[k] : -1;
#else
    return k < width * height ? k : -1;
#endif
}

void blend_many(const Around around, __local uint4 *list, __global const uchar4 *target_photo,
                __global const float *exposure, int view, float threshold, float relative, int pixel,
                __global float *rendered)
{
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
    store_blend(color, 1.0f - transmittance, pixel, rendered);
}

__kernel IN_GROUPS
void composite_crowded(__global const uchar4 *target_photo, __global const float *exposure, int view,
                       __global const int *heads, __global const int2 *links, __global float *alphas,
                       __global const int *crowded, int count, int width, int height, float threshold, float relative,
                       __global float *rendered)
{
    __local uint4 lists[SLOTS * GROUP];
    for (int k = get_global_id(0);; k += get_global_size(0)) {
        const int pixel = crowded_pixel(k, heads, crowded, width, height);
        if (pixel < 0)
            return;
        const Around around = look_around(heads, links, alphas, count, pixel % width, pixel / width, width);
        blend_many(around, lists + get_local_id(0), target_photo, exposure, view, threshold, relative, pixel, rendered);
    }
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
               __global const float *exposure, int view, color_t v_color, float v_coverage,
               float *behind_color, float *behind_open)
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

// Both ways over the lists of one pixel.
void pass_back_many(const Around around, __local uint4 *list, __global const uchar4 *target_photo,
                    __global const float *exposure, int view, float threshold, float relative, color_t v_color,
                    float v_coverage)
{
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
    pass_back(around, list, kept, transmittance, target_photo, exposure, view, v_color, v_coverage, &behind_color,
              &behind_open);
    while (chunk-- > 0) {
        gather(around, starts[chunk], chunk == 0, list);
        pass_back(around, list, SLOTS, in_front[chunk], target_photo, exposure, view, v_color, v_coverage, &behind_color,
                  &behind_open);
    }
    if (taking_part < all)
        clear_behind(around, last, taking_part == 0);
}

__kernel IN_GROUPS
void composite_crowded_vjp(__global const uchar4 *target_photo, __global const float *exposure, int view,
                           __global const int *heads, __global const int2 *links, __global float *alphas,
                           __global const int *crowded, int count, int width, int height, float threshold,
                           float relative, __global const float *upstream)
{
    __local uint4 lists[SLOTS * GROUP];
    for (int k = get_global_id(0);; k += get_global_size(0)) {
        const int pixel = crowded_pixel(k, heads, crowded, width, height);
        if (pixel < 0)
            return;
        const Around around = look_around(heads, links, alphas, count, pixel % width, pixel / width, width);
        float v_coverage;
        const color_t v_color = load_upstream(upstream, pixel, &v_coverage);
        pass_back_many(around, lists + get_local_id(0), target_photo, exposure, view, threshold, relative, v_color,
                       v_coverage);
    }
}
