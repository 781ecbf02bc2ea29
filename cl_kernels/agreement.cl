// Refined depth maps of other views as evidence for one another (method section 8.1). Lengths in units; `scale` is
// units per scene unit, in which the maps come.
//   count_differences   how far one other view's surface is from the target's, counted in bins
//   add_view            what that view says of each depth, weighted by deviations
//   average             depth, deviation and status that follow
#define CAMERA_SPACE __global const      // all views of a scene at once, more than constant memory may hold
#include "camera.clh"

#define EDGE 3.0f                        // pixels of parallax: corners of a cell that differ by more are two surfaces
#define MOST_UNSURE 0.5f                 // pixels of parallax: more than that a deviation does not count
#define LENIENCE 2.0f                    // of `spread`: weights know no smaller deviation
#define IN_COMMON 0.3f                   // share of their variance that views have in common and no average takes out

// Of a map, what others are told: depths that photos confirm, 0 for all others.
float confirmed(__global const float *map, __global const float *deviations, __global const uchar *statuses, int i)
{
    return statuses[i] == REFINED && deviations[i] < INFINITY ? map[i] : 0.0f;
}

// x: how much the target's depth would have to change for its point to lie on the other view's surface, the plane
// through the cell of four pixels that the point lands in, whose inverse depth w is linear in the image, so that z w = 1
// is solved by one step. y: deviation of that view there. z: a pixel of parallax; 0 where that view says nothing: it
// does not see the point, one of the four has no refined depth, or there is a depth edge between them.
float3 difference(const Camera target, CAMERA_SPACE float *cameras, int view, int column, int row, float scale,
                  __global const float *depth, __global const float *depth_per_parallax, __global const float *map,
                  __global const float *deviations, __global const uchar *statuses)
{
    const Camera other = load_camera(cameras, view);
    const int own = row * target.width + column;
    const float d = depth[own] * scale, u = depth_per_parallax[own] * scale;
    const float3 nothing = (float3)(0.0f), q = turned_ray(target, other, column, row), m = project_ray(other, q, d);
    const float x = m.x - 0.5f, y = m.y - 0.5f;
    if (!(d > 0.0f && u > 0.0f && m.z > NEAR && x >= 0.0f && y >= 0.0f && x < other.width - 1 && y < other.height - 1))
        return nothing;
    const int left = (int)x, top = (int)y, i = top * other.width + left, j = i + other.width;
    const float4 corners = scale * (float4)(confirmed(map, deviations, statuses, i),
                                            confirmed(map, deviations, statuses, i + 1),
                                            confirmed(map, deviations, statuses, j),
                                            confirmed(map, deviations, statuses, j + 1));
    const float near = fmin(fmin(corners.s0, corners.s1), fmin(corners.s2, corners.s3));
    const float far = fmax(fmax(corners.s0, corners.s1), fmax(corners.s2, corners.s3));
    if (!(near > 0.0f && far - near < EDGE * u))
        return nothing;
    const float a = x - left, b = y - top;
    const float4 w4 = 1.0f / corners;
    const float2 slope = (float2)((1 - b) * (w4.s1 - w4.s0) + b * (w4.s3 - w4.s2),
                                  (1 - a) * (w4.s2 - w4.s0) + a * (w4.s3 - w4.s1));
    const float w = (1 - b) * ((1 - a) * w4.s0 + a * w4.s1) + b * ((1 - a) * w4.s2 + a * w4.s3);
    const float d_zw = q.z * w + dot(slope, dmean_ddepth(other, q)) / m.z;      // d (z w) / d depth
    const float unsure = fmax(fmax(deviations[i], deviations[i + 1]), fmax(deviations[j], deviations[j + 1]));
    return d_zw > 0.0f ? (float3)((1.0f - m.z * w) / d_zw, unsure * scale, u) : nothing;
}

// Pixels of parallax; beyond BINS / PER_PIXEL views mean different surfaces. Of every `stride`-th pixel each way.
__kernel void count_differences(__global const float *depth, __global const float *deviation,
                                __global const uchar *status, __global const float *depth_per_parallax,   // scene units
                                CAMERA_SPACE float *cameras, int view, float scale, __global const float *map,
                                __global const float *deviations, __global const uchar *statuses, int stride, int bins,
                                float per_pixel, __global uint *counts)
{
    const Camera target = load_camera(cameras, 0);
    const int column = get_global_id(0) * stride, row = get_global_id(1) * stride;
    if (column >= target.width || row >= target.height
        || !(confirmed(depth, deviation, status, row * target.width + column) > 0.0f))
        return;
    const float3 told = difference(target, cameras, view, column, row, scale, depth, depth_per_parallax, map,
                                   deviations, statuses);
    const float bin = fabs(told.x) / told.z * per_pixel;
    if (bin < bins)                                // not where it is NaN
        atomic_inc(counts + (int)bin);
}

// Variance that a depth counts with: its own deviation as far as it can be believed, and what maps differ by.
float variance_of(float deviation, float u, float floor)
{
    const float s = fmin(deviation, MOST_UNSURE * u), least = floor * u;
    return s * s + least * least;
}

__kernel void add_view(__global const float *depth, __global const float *depth_per_parallax,      // scene units
                       CAMERA_SPACE float *cameras, int view, float scale, __global const float *map,
                       __global const float *deviations, __global const uchar *statuses, float spread, float pixels,
                       __global float *sums)                       // [H, W, 4] w change, w, w^2 and w times variances
{
    const Camera target = load_camera(cameras, 0);
    EACH_PIXEL(column, row, i, target.width, target.height)
    const float3 told = difference(target, cameras, view, column, row, scale, depth, depth_per_parallax, map,
                                   deviations, statuses);
    const float u = told.z, off = fabs(told.x) / (pixels * u), t = off * off, rest = 1.0f - t * t * t * t;
    if (!(off < 1.0f))
        return;
    const float w = rest * rest / variance_of(told.y, u, LENIENCE * spread);
    const float v = variance_of(told.y, u, spread);
    vstore4(vload4(i, sums) + (float4)(w * told.x, w, w * w * v, w * v), i, sums);
}

// status: of the depth as it is; one that was rejected has no weight of its own, and where the others are to `propose`
// another one that is refined from then on.
__kernel void average(int count, float scale, float spread, int propose, __global const float *sums,
                      __global const float *depth, __global const float *depth_per_parallax,
                      __global const float *deviation, __global const uchar *status,
                      __global float *averaged, __global float *surer, __global uchar *found)      // [H, W] what follows
{
    EACH(i, count)
    const float4 sum = vload4(i, sums);
    averaged[i] = depth[i];
    surer[i] = deviation[i];
    found[i] = status[i];
    if (!(sum.s1 > 0.0f) || (status[i] != REFINED && !propose))
        return;
    const float u = depth_per_parallax[i] * scale, s = deviation[i] * scale;
    const bool own = status[i] == REFINED && s < INFINITY;
    const float w = own ? 1.0f / variance_of(s, u, LENIENCE * spread) : 0.0f, v = variance_of(s, u, spread);
    const float weight = sum.s1 + w;
    const float alone = (sum.s2 + w * w * v) / (weight * weight), mean = (sum.s3 + w * v) / weight;
    averaged[i] = depth[i] + sum.s0 / weight / scale;
    surer[i] = sqrt(IN_COMMON * mean + (1.0f - IN_COMMON) * alone) / scale;
    found[i] = REFINED;
}
