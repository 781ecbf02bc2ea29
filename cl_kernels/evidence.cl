// What is concluded from how well patches match (patches.cl; method section 7).
#include "constants.clh"

#define CHANCE 0.02f                 // growth of 1 - correlation in a photo, mean around a pixel, that says nothing

#define WINDOW 7                     // half the width of the surroundings in which patches must match

// values: every `stride` floats a sum of 1 - correlation and a number of views; sums of them over WINDOW pixels to each
// side, along rows (dx = 1) or columns (dy = 1). Twice gives the surroundings of each pixel.
__kernel void sum_window(__global const float *values, int stride, int width, int height, int dx, int dy,
                         __global float *sums)                     // [H, W, 2]
{
    EACH_PIXEL(column, row, i, width, height)
    float2 sum = 0.0f;
    for (int k = -WINDOW; k <= WINDOW; ++k) {
        const int x = column + k * dx, y = row + k * dy;
        if (x >= 0 && y >= 0 && x < width && y < height) {
            __global const float *e = values + stride * (y * width + x);
            sum += (float2)(e[0], e[1]);
        }
    }
    vstore2(sum, i, sums);
}

// before, after: evidence under the initial and the refined depth, to which a depth may go back; around: that of the
// surroundings.
__kernel void decide(__global const float *initial, __global float *depth, __global const float *depth_per_parallax,
                     int count, __global const float *before, __global const float *after,     // evidence, [H, W, 3]
                     __global const float *around,                 // [H, W, 2], twice through sum_window
                     float max_move, float tolerance, float mismatch, __global uchar *status)
{
    EACH(i, count)
    const float d0 = initial[i], d = depth[i];
    const float3 was = vload3(i, before), is = vload3(i, after);
    const float2 near = vload2(i, around);
    uchar decision = REFINED;
    if (!(d0 > 0.0f))
        decision = NO_SURFACE;
    else if (depth_per_parallax[i] == 0.0f || is.y == 0.0f)
        decision = KEPT;
    else if (!(fabs(d - d0) <= max_move * depth_per_parallax[i]))
        decision = REJECTED;
    else if (was.y > 0.0f && is.x * was.y > was.x * is.y + tolerance * was.y * is.y)
        decision = REJECTED;
    else if (near.x > mismatch * near.y)
        decision = REJECTED;
    status[i] = decision;
    depth[i] = decision == REFINED ? d : d0;
}

#define SEAM 3                       // half the width of the surroundings that a seam spreads over

// What was rejected goes back. A refined depth moves all the way where everything around it is refined, and less
// towards what went back, so that no seam is left between the two. (What no view sees was held in place all along.)
__kernel void feather(__global const float *initial, __global float *depth, __global const uchar *status, int width,
                      int height)
{
    EACH_PIXEL(column, row, i, width, height)
    if (status[i] == REJECTED)
        depth[i] = initial[i];
    if (status[i] != REFINED)
        return;
    float refined = 0.0f, all = 0.0f;
    EACH_AROUND(x, y, column, row, SEAM, width, height) {
        const uchar other = status[y * width + x];
        refined += other == REFINED ? 1.0f : 0.0f;
        all += other == REFINED || other == REJECTED ? 1.0f : 0.0f;
    }
    if (refined < all)
        depth[i] = initial[i] + clamp(2.0f * refined / all - 1.0f, 0.0f, 1.0f) * (depth[i] - initial[i]);
}

// 1 - correlation before and after of a pixel that is seen both times.
bool costs_of(__global const float *before, __global const float *after, int i, float2 *costs)
{
    const float3 was = vload3(i, before), is = vload3(i, after);
    *costs = (float2)(was.x / was.y, is.x / is.y);
    return was.y > 0.0f && is.y > 0.0f;
}

// Sums of 1 - correlation before and after, and the number of pixels that are seen both times: three numbers a group.
__kernel __attribute__((reqd_work_group_size(COST_GROUP, 1, 1)))
void sum_costs(__global const float *before, __global const float *after, int count,       // evidence, [count, 3]
               __global long *sums)                                // [groups, 3]
{
    __local long scratch[3][COST_GROUP];
    const int lane = get_local_id(0);
    long was_sum = 0, is_sum = 0, pixels = 0;
    for (int i = get_global_id(0); i < count; i += get_global_size(0)) {
        float2 costs;
        if (!costs_of(before, after, i, &costs))
            continue;
        was_sum += convert_long_rte(costs.x * COST_ONE);
        is_sum += convert_long_rte(costs.y * COST_ONE);
        ++pixels;
    }
    scratch[0][lane] = was_sum;
    scratch[1][lane] = is_sum;
    scratch[2][lane] = pixels;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (lane < 3) {
        long sum = 0;
        for (int k = 0; k < COST_GROUP; ++k)
            sum += scratch[lane][k];
        sums[3 * get_group_id(0) + lane] = sum;
    }
}

// How often each 1 - correlation occurs before and after, in COST_BINS bins of 0 to 2,
// over the pixels that are seen both times.
__kernel void count_costs(__global const float *before, __global const float *after, int count,
                          __global uint *counts)                   // [2, COST_BINS]
{
    EACH(i, count)
    float2 costs;
    if (!costs_of(before, after, i, &costs))
        return;
    atomic_inc(counts + clamp((int)(costs.x * (COST_BINS / 2)), 0, COST_BINS - 1));
    atomic_inc(counts + COST_BINS + clamp((int)(costs.y * (COST_BINS / 2)), 0, COST_BINS - 1));
}

// By how much 1 - correlation grew beyond chance, and 1; two zeros where it is not known.
__kernel void worse_costs(__global const float *before, __global const float *after, int count,
                          __global float *worse)                   // [count, 2]
{
    EACH(i, count)
    float2 costs;
    const bool known = costs_of(before, after, i, &costs);
    vstore2(known ? (float2)(costs.y - costs.x - CHANCE, 1.0f) : (float2)(0.0f), i, worse);
}

// A refined depth is rejected where a photo that took no part matches worse around it.
__kernel void refuse(int count, __global const float *worse, __global uchar *status)
{
    EACH(i, count)
    if (status[i] == REFINED && worse[2 * i] > 0.0f)
        status[i] = REJECTED;
}

// Refined depths that photos confirm.
__kernel void mark_informative(__global const uchar *status, __global const float *deviation, int count,
                               __global float *informative)        // [count, 2] 1 or 0, and 0
{
    EACH(i, count)
    vstore2((float2)(status[i] == REFINED && deviation[i] < INFINITY ? 1.0f : 0.0f, 0.0f), i, informative);
}

#define ENOUGH_AROUND 60.0f          // pixels within WINDOW that photos confirm; with fewer a depth moves less

// What photos show nothing of goes back towards where it was; without any around that they confirm it is kept.
__kernel void hold_uninformative(__global const float *initial, __global float *depth, __global const float *deviation,
                                 __global const float *around,     // [count, 2], informative through sum_window
                                 int count, __global uchar *status,
                                 __global volatile uint *uninformative)      // number of them
{
    EACH(i, count)
    const float share = around[2 * i] * (1.0f / ENOUGH_AROUND), d0 = initial[i];
    if (status[i] != REFINED || deviation[i] < INFINITY || share >= 1.0f)
        return;
    const float d = d0 + share * (depth[i] - d0);
    depth[i] = d;
    if (d == d0) {
        status[i] = KEPT;
        atomic_inc(uninformative);
    }
}
