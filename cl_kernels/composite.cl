// Order-free blend (method section 4): scatter weights and weighted colours as whole numbers.
//
// sums holds, per context pixel, fixed-point [weight, red, green, blue] ([weight, grey] with GREY). It is empty before
// the first view; from then on loss.cl empties what it reads, or each strip begins by emptying its own rows.
#include "weights.clh"
#include "exposed.clh"

// A box: the part of a context image that the Gaussians of one work-group land in, kept in local memory. Most pixels are
// reached by several of them, so that few additions are left for the image; what lands outside goes to it at once.
#define BOX 1024                       // pixels of it, at most
#define BOX_GROUP (BOX_GROUP_W * BOX_GROUP_H)

#if ONE_PIXEL && !defined(GREY)          // not worth its while for the one addition a pair of a grey image
#define BOXED

typedef struct {
    int x, y, width, height;
} Box;

// From where the Gaussians at the four corners of the group land: on a smooth surface all others land between them.
// `corners` is for the group's own use; passes a barrier.
Box reached_box(const Gaussians *g, __local int corners[4])
{
    const int x = get_local_id(0), y = get_local_id(1);
    if (x == 0 && y == 0) {
        corners[0] = corners[1] = INT_MAX;
        corners[2] = corners[3] = INT_MIN;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    if ((x == 0 || x == BOX_GROUP_W - 1) && (y == 0 || y == BOX_GROUP_H - 1) && g->own) {
        atomic_min(&corners[0], g->x - 1);
        atomic_min(&corners[1], g->y - 1);
        atomic_max(&corners[2], g->x + SPAN + 1);
        atomic_max(&corners[3], g->y + SPAN + 1);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    Box box;
    box.x = corners[0];
    box.y = corners[1];
    box.width = corners[2] > corners[0] ? min(corners[2] - box.x, BOX) : 0;
    box.height = box.width > 0 ? min(corners[3] - box.y, BOX / box.width) : 0;
    return box;
}

// -1 outside
int place_in_box(const Box box, int x, int y)
{
    const int u = x - box.x, v = y - box.y;
    return u >= 0 && v >= 0 && u < box.width && v < box.height ? v * box.width + u : -1;
}
#endif

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

void add_to_image(__global volatile uint *sum, const uint parts[CHANNELS + 1])
{
    add_pair(sum, parts[0], parts[1]);
#ifndef GREY
    add_pair(sum + 2, parts[2], parts[3]);
#endif
}

#if ONE_PIXEL
__kernel __attribute__((reqd_work_group_size(BOX_GROUP_W, BOX_GROUP_H, 1)))
void splat_order_free(__global const float *depth, __global const uchar4 *target_photo, __constant float *cameras,
                      int view, float radius_threshold, float inverse_area, float low_pass, float depth_threshold,
                      float depth_relative, __global const uint *z_first, __global const float *exposure,
                      __global const int *row_ranges, __global volatile uint *sums)
{
    const Camera target = load_camera(cameras, 0), context = load_camera(cameras, view);
    int column;
    const int row = get_global_id(1);
    const Gaussians g = load_gaussians(depth, target, context, get_global_id(0), row, radius_threshold, low_pass,
                                       &column);
#ifdef BOXED
    __local uint boxed[(CHANNELS + 1) * BOX];
    __local int corners[4];
    const Box box = reached_box(&g, corners);
    const int item = get_local_id(1) * BOX_GROUP_W + get_local_id(0);
    for (int k = item; k < box.width * box.height; k += BOX_GROUP)
        for (int c = 0; c <= CHANNELS; ++c)
            boxed[c * BOX + k] = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
#endif
    if (g.own) {
        float color[CHANNELS];
        load_exposed(target_photo, row * target.width + column, exposure, view, color);
        EACH_PLACE(u, v) {
            const Reach r = reach_pixel(&g, context.width, 0, context.height, u, v);
            const float share = r.reached ? share_of(&g, r, z_first, depth_threshold, depth_relative) : 0.0f;
            if (!(share > 0.0f))
                continue;
            const float weight = tapered_alpha(g.splat, r.dx, r.dy, inverse_area) * (share * FIXED_ONE);
            uint parts[CHANNELS + 1] = {ROUND_SHORT(weight)};
            for (int c = 0; c < CHANNELS; ++c)
                parts[c + 1] = ROUND_SHORT(weight * color[c]);
#ifdef BOXED
            const int place = place_in_box(box, g.x + u, g.y + v);
            if (place >= 0)
                for (int c = 0; c <= CHANNELS; ++c)
                    atomic_add(&boxed[c * BOX + place], parts[c]);
            else
#endif
                add_to_image(sums + r.pixel * (CHANNELS + 1), parts);
        }
    }
#ifdef BOXED
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int k = item; k < box.width * box.height; k += BOX_GROUP) {
        uint parts[CHANNELS + 1];
        for (int c = 0; c <= CHANNELS; ++c)
            parts[c] = boxed[c * BOX + k];
        const int pixel = (box.y + k / box.width) * context.width + box.x + k % box.width;
        if (parts[0])
            add_to_image(sums + pixel * (CHANNELS + 1), parts);
    }
#endif
}
#else
__kernel void splat_order_free(__global const float *depth, __global const uchar4 *target_photo,
                               __constant float *cameras, int view, float radius_threshold, float inverse_area,
                               float low_pass, float depth_threshold, float depth_relative,
                               __global const uint *z_first, __global const float *exposure,
                               __global const int *row_ranges, __global int *sums)     // [H', W', CHANNELS + 1]
{
    const Camera target = load_camera(cameras, 0), context = load_camera(cameras, view);
    const Strip strip = own_strip(context);
    const int row_sums = context.width * (CHANNELS + 1);
    for (int i = strip.from * row_sums; i < strip.to * row_sums; ++i)
        sums[i] = 0;
    EACH_IN_STRIP(item, row, row_ranges, strip, target, BLOCKS_ACROSS(target)) {
        int column;
        const Gaussians g = load_gaussians(depth, target, context, item, row, radius_threshold, low_pass, &column);
        if (!ANY(g.own & (g.y < strip.to) & (g.y + SPAN > strip.from)))
            continue;
        const columns_t one = 1.0f;
        columns_t color[CHANNELS];
        load_exposed(target_photo, row * target.width + column, exposure, view, color);
        columns_t paint[CHANNELS + 1], weights[PLACES];
        mask_t pixels[PLACES];
#ifdef GREY
        STORE_TWO(one, color[0], (float *)paint)
#else
        STORE_FOUR(one, color[0], color[1], color[2], (float *)paint)
#endif
        EACH_PLACE(u, v) {
            const Reach r = reach_pixel(&g, context.width, strip.from, strip.to, u, v);
            const columns_t share = share_of(&g, r, z_first, depth_threshold, depth_relative);
            const columns_t weight = tapered_alpha(g.splat, r.dx, r.dy, inverse_area) * (share * FIXED_ONE);
            weights[v * SPAN + u] = select(ZERO, weight, share > 0.0f);
            pixels[v * SPAN + u] = r.pixel;
        }
        for (int k = 0; k < COLUMNS; ++k) {
            const PAINT(float) own = PAINT(vload)(k, (const float *)paint);
            UNROLL_SPAN for (int place = 0; place < PLACES; ++place) {
                const PAINT(int) part = PAINT(convert_int)(LANE(float, weights[place], k) * own + 0.5f);
                const int pixel = LANE(int, pixels[place], k);
                PAINT(vstore)(PAINT(vload)(pixel, sums) + part, pixel, sums);
            }
        }
    }
}
#endif
