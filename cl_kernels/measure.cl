// What a scene calls for, measured on a grid of samples under the initial depth (method section 8).
//
// One record of RECORD floats a sample and context view:
//   0     1 seen, 2 hidden behind a nearer surface, 0 outside the photo or masked
//   1     standard deviation of the projected Gaussian, pixels
//   2-4   colour of the target, 5-7 of the context photo
//   8-    1 - correlation of patches with the depth moved by SHIFTS pixels of parallax; 2 where it is not defined
#include "splat.clh"

#define HALF 2
#define SHIFTS 7
#define RECORD (8 + SHIFTS)
#define LEAST_PIXELS 15

__constant float SHIFT[SHIFTS] = {-4.0f, -2.0f, -1.0f, 0.0f, 1.0f, 2.0f, 4.0f};

float luma(float3 c)
{
    return 0.299f * c.x + 0.587f * c.y + 0.114f * c.z;
}

float3 rgb_of(uchar4 p)
{
    return convert_float3(p.xyz) * (1.0f / 255.0f);
}

// Bilinear colour of the photo; false outside it and where it is masked.
bool look_up(__global const uchar4 *photo, const Camera context, float2 mean, float3 *color)
{
    const float u = mean.x - 0.5f, v = mean.y - 0.5f;
    if (!(u >= 0.0f && v >= 0.0f && u < context.width - 1 && v < context.height - 1))
        return false;
    const int x = (int)u, y = (int)v;
    const float a = u - x, b = v - y;
    __global const uchar4 *p = photo + y * context.width + x;
    if (p[0].w == 0 || p[1].w == 0 || p[context.width].w == 0 || p[context.width + 1].w == 0)
        return false;
    *color = (1 - b) * ((1 - a) * rgb_of(p[0]) + a * rgb_of(p[1]))
           + b * ((1 - a) * rgb_of(p[context.width]) + a * rgb_of(p[context.width + 1]));
    return true;
}

// 1 - correlation of the 5x5 patch around a target pixel with the context photo, depths moved by `shift` pixels.
float shifted_cost(__global const float *depth, __global const float *unit, const Camera target, const Camera context,
                   __global const uchar4 *target_photo, __global const uchar4 *photo, int column, int row, float shift)
{
    float n = 0.0f, w = 0.0f, t = 0.0f, ww = 0.0f, tt = 0.0f, wt = 0.0f;
    for (int y = max(row - HALF, 0); y <= min(row + HALF, target.height - 1); ++y)
        for (int x = max(column - HALF, 0); x <= min(column + HALF, target.width - 1); ++x) {
            const int i = y * target.width + x;
            const float d = depth[i] + shift * unit[i];
            float3 color;
            if (!(depth[i] > 0.0f && d > NEAR))
                continue;
            const float3 m = project_mean(target, context, x, y, d);
            if (!(m.z > NEAR) || !look_up(photo, context, m.xy, &color))
                continue;
            const float a = luma(color), b = luma(rgb_of(target_photo[i]));
            n += 1.0f;
            w += a;
            t += b;
            ww += a * a;
            tt += b * b;
            wt += a * b;
        }
    const float noise = 1.5e-5f, inverse = 1.0f / fmax(n, 1.0f);
    const float vw = ww * inverse - w * w * inverse * inverse, vt = tt * inverse - t * t * inverse * inverse;
    if (n < LEAST_PIXELS || vt < 4.0f * noise)
        return 2.0f;
    return 1.0f - (wt * inverse - w * t * inverse * inverse) / sqrt((fmax(vw, 0.0f) + noise) * (vt + noise));
}

__kernel void sample_view(__global const float *depth, __global const float *unit, __global const float *cameras, int view,
                          float low_pass, float threshold, __global const uint *z_first,
                          __global const uchar4 *target_photo, __global const uchar4 *photo, int stride, int across,
                          int down, __global float *records)
{
    const Camera target = load_camera(cameras, 0), context = load_camera(cameras, view);
    const int k = get_global_id(0);
    if (k >= across * down)
        return;
    const int column = min(k % across * stride + stride / 2, target.width - 1);
    const int row = min(k / across * stride + stride / 2, target.height - 1), i = row * target.width + column;
    __global float *record = records + k * RECORD;
    for (int j = 0; j < RECORD; ++j)
        record[j] = j < 8 ? 0.0f : 2.0f;
    const float d = depth[i];
    Splat splat;
    Motion motion;
    float3 color;
    if (!(d > 0.0f) || !project_gaussian(target, context, column, row, d, 0.5f, low_pass, &splat, &motion)
        || !look_up(photo, context, (float2)(splat.x, splat.y), &color))
        return;
    const int pixel = (int)splat.y * context.width + (int)splat.x;
    const bool hidden = splat.z > as_float(z_first[pixel]) + threshold;
    const float3 own = rgb_of(target_photo[i]);
    record[0] = hidden ? 2.0f : 1.0f;
    record[1] = rsqrt(sqrt(splat.kxx * splat.kyy - splat.kxy * splat.kxy));
    vstore3(own, 0, record + 2);
    vstore3(color, 0, record + 5);
    for (int j = 0; j < SHIFTS && !hidden; ++j)
        record[8 + j] = shifted_cost(depth, unit, target, context, target_photo, photo, column, row, SHIFT[j]);
}
