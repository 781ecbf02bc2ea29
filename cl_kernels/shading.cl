// Context photos without what light does otherwise there than in the target's photo, over whole surroundings (method
// section 5.3).
#include "lookup.clh"

#define SPREAD 2                         // cells to each side that a difference is averaged over
#define DIFFERENCE_ONE 65536.0f          // whole numbers: the order of arrival does not matter

// Between colours of both photos at the samples (exposure.cl), by the cell of the photo around each.
__kernel void add_differences(__global const float *depth, __constant float *cameras, int view, int stride, int across,
                              int count, __global const float *matches, int cell, int cells_across, __global int *sums)
{
    const Camera target = load_camera(cameras, 0), context = load_camera(cameras, view);
    EACH(k, count)
    __global const float *match = matches + 8 * ((view - 1) * count + k);
    if (match[3] == 0.0f)
        return;
    const int2 at = sample_place(k, stride, across, target);
    const float3 m = project_mean(target, context, at.x, at.y, depth[at.y * target.width + at.x]);
    __global int *sum = sums + 4 * ((int)m.y / cell * cells_across + (int)m.x / cell);
    for (int c = 0; c < 3; ++c)
        atomic_add(sum + c, convert_int_rte((match[4 + c] - match[c]) * DIFFERENCE_ONE));
    atomic_add(sum + 3, 1);
}

__kernel void average_differences(__global const int *sums, int cells_across, int cells_down,
                                  __global float *differences)                       // [cells, 4]
{
    EACH(k, cells_across * cells_down)
    int4 sum = 0;
    EACH_AROUND(u, v, k % cells_across, k / cells_across, SPREAD, cells_across, cells_down)
        sum += vload4(v * cells_across + u, sums);
    vstore4(convert_float4(sum) * (1.0f / DIFFERENCE_ONE) / max(sum.w, 1), k, differences);
}

__kernel void relight(__global const uchar4 *photo, int width, int height, __global const float *differences, int cell,
                      int cells_across, int cells_down, __global uchar4 *relit)
{
    EACH_PIXEL(column, row, i, width, height)
    const float u = clamp((column + 0.5f) / cell - 0.5f, 0.0f, cells_across - 1.0f);
    const float v = clamp((row + 0.5f) / cell - 0.5f, 0.0f, cells_down - 1.0f);
    const int x = (int)u, y = (int)v, right = x + 1 < cells_across, below = y + 1 < cells_down ? cells_across : 0;
    const float a = u - x, b = v - y;
    const int at = y * cells_across + x;
    const float4 difference = BETWEEN(a, b, vload4(at, differences), vload4(at + right, differences),
                                      vload4(at + below, differences), vload4(at + below + right, differences));
    const uchar4 own = photo[i];
    relit[i] = (uchar4)(convert_uchar3_sat_rte(255.0f * (rgb_of(own) - difference.xyz)), own.w);
}
