// Which depths other views confirm, and which they should see (method section 7). Lengths in units; `scale` is units
// per scene unit, in which the depth maps come.
#define CAMERA_SPACE __global const      // all views of a scene at once, more than constant memory may hold
#include "camera.clh"

#define FRONT 1e-6f                      // share of the target's depth: a point nearer to a camera is behind it
#define OCCLUDED 0.05f                   // share of the depth: a surface nearer by more hides what is behind it

// Where a depth of the target lands in another view: false behind it and outside its image.
bool land(const Camera target, const Camera other, int column, int row, float d, float3 *mean)
{
    *mean = project_mean(target, other, column, row, d);
    return mean->z > FRONT * d && in_image(other, *mean);
}

// Depth that moves a point of the target by one pixel, over the views that see it.
__kernel void parallax(__global const float *depth,                // [H, W] scene units, 0 = no surface
                       CAMERA_SPACE float *cameras, int views, float scale,
                       __global float *depth_per_parallax)         // [H, W] units, 0 = not known
{
    const Camera target = load_camera(cameras, 0);
    EACH_PIXEL(column, row, i, target.width, target.height)
    const float d = depth[i] * scale;
    float sum = 0.0f, number = 0.0f;
    for (int view = 1; view <= views && d > 0.0f; ++view) {
        const Camera other = load_camera(cameras, view);
        float3 mean;
        if (!land(target, other, column, row, d, &mean))
            continue;
        const float2 moved = dmean_ddepth(other, turned_ray(target, other, column, row)) / (mean.z * mean.z);
        sum += dot(moved, moved);
        number += 1.0f;
    }
    depth_per_parallax[i] = sum > 0.0f ? sqrt(number / sum) : 0.0f;
}

// |own depth - z|: the smaller of the pixel's own and, where all four neighbours are valid, their interpolation.
// Inverse depth is interpolated, since it is linear in the image on every plane.
float difference(__global const float *map, const Camera other, float3 mean, float near, float scale)
{
    const float best = near > 0.0f ? fabs(near - mean.z) : INFINITY;
    const float x = clamp(mean.x - 0.5f, 0.0f, other.width - 1.0f), y = clamp(mean.y - 0.5f, 0.0f, other.height - 1.0f);
    const int left = min((int)x, max(other.width - 2, 0)), top = min((int)y, max(other.height - 2, 0));
    float inverse = 0.0f;
    for (int v = 0; v <= 1; ++v)
        for (int u = 0; u <= 1; ++u) {
            const int at = min(top + v, other.height - 1) * other.width + min(left + u, other.width - 1);
            const float corner = map[at] * scale;
            if (!(corner > 0.0f))
                return best;
            inverse += (u ? x - left : 1.0f - (x - left)) * (v ? y - top : 1.0f - (y - top)) / corner;
        }
    return fmin(best, fabs(1.0f / inverse - mean.z));
}

// Add what one other view says of each depth: whether it confirms it to within `pixels` of parallax, and should see it.
__kernel void count_view(__global const float *depth,              // [H, W] scene units
                         CAMERA_SPACE float *cameras, int view, float scale,
                         __global const float *map,                // [H', W'] scene units
                         __global const float *depth_per_parallax, float pixels,
                         __global ushort2 *counts)                 // [H, W]
{
    const Camera target = load_camera(cameras, 0), other = load_camera(cameras, view);
    EACH_PIXEL(column, row, i, target.width, target.height)
    const float d = depth[i] * scale;
    float3 mean;
    if (!(d > 0.0f) || !land(target, other, column, row, d, &mean))
        return;
    const float near = map[(int)mean.y * other.width + (int)mean.x] * scale;
    if (depth_per_parallax[i] > 0.0f && difference(map, other, mean, near, scale) <= pixels * depth_per_parallax[i])
        counts[i].x += 1;
    if (near > 0.0f && mean.z < near * (1.0f + OCCLUDED))
        counts[i].y += 1;
}
