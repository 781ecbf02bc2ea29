// What photos leave open about a depth that follows them, and how the surface bends (method section 5.2), on a grid of
// samples: logarithms to base 2, NaN where there is none.
//   sample_bends   second differences of inverse depth over NEAR_BY and twice as many pixels, across and down: 4 rows
//   sample_match   variance of the depth by how a context photo differs from the target's through it: a row a view
#include "lookup.clh"

#define NEAR_BY 4                    // pixels
#define PATCH 2                      // half the width of a patch
#define LEAST_PIXELS 20              // of a patch must be seen
#define NOISE (1.0f / 255.0f)        // of a photo: what a residual never falls below
#define CONFIRMED 0.25f              // least share of a patch's variance that the match explains

float bend_over(__global const float *depth, float kappa, int i, int step, int at, int length, int stride)
{
    if (at < step || at >= length - step)
        return NAN;
    const float d = depth[i], a = depth[i - step * stride], b = depth[i + step * stride];
    const float bend = a > 0.0f && b > 0.0f ? kappa * fabs(second_difference(a, d, b)) : 0.0f;
    return bend > 0.0f ? log2(bend) : NAN;
}

__kernel void sample_bends(__global const float *depth, __global const float *kappa, __constant float *cameras,
                           int stride, int across, int count, __global float *rows)                // [4, samples]
{
    const Camera target = load_camera(cameras, 0);
    EACH(k, count)
    const int2 at = sample_place(k, stride, across, target);
    const int i = at.y * target.width + at.x;
    const bool known = depth[i] > 0.0f && kappa[i] > 0.0f;
    for (int far = 0; far < 2; ++far) {
        const int step = NEAR_BY << far;
        rows[2 * far * count + k] = known ? bend_over(depth, kappa[i], i, step, at.x, target.width, 1) : NAN;
        rows[(2 * far + 1) * count + k] =
            known ? bend_over(depth, kappa[i], i, step, at.y, target.height, target.width) : NAN;
    }
}

// Luma of the context photo where a target pixel lands with depth d.
bool seen_at(__global const uchar4 *photo, const Camera context, float3 q, float d, float *grey)
{
    float3 color;
    const float3 m = project_ray(context, q, d);
    const bool seen = d > NEAR && m.z > NEAR && look_up(photo, context, m.xy, &color);
    *grey = seen ? LUMA(color.x, color.y, color.z) : 0.0f;
    return seen;
}

__kernel void sample_match(__global const float *depth, __global const float *depth_per_parallax,
                           __constant float *cameras, int view, __global const uchar4 *target_photo,
                           __global const uchar4 *photo, int stride, int across, int count, int row,
                           __global float *rows)                   // squared pixels of parallax
{
    const Camera target = load_camera(cameras, 0), context = load_camera(cameras, view);
    EACH(k, count)
    const int2 at = sample_place(k, stride, across, target);
    float n = 0.0f, w = 0.0f, t = 0.0f, s = 0.0f, ww = 0.0f, tt = 0.0f, wt = 0.0f, ss = 0.0f;
    for (int y = max(at.y - PATCH, 0); y <= min(at.y + PATCH, target.height - 1); ++y)
        for (int x = max(at.x - PATCH, 0); x <= min(at.x + PATCH, target.width - 1); ++x) {
            const int i = y * target.width + x;
            const float d = depth[i], half_pixel = 0.5f * depth_per_parallax[i];
            const float3 q = turned_ray(target, context, x, y), own = rgb_of(target_photo[i]);
            float a, before, behind;
            if (!(d > 0.0f && half_pixel > 0.0f && seen_at(photo, context, q, d, &a)
                  && seen_at(photo, context, q, d - half_pixel, &before)
                  && seen_at(photo, context, q, d + half_pixel, &behind)))
                continue;
            const float b = LUMA(own.x, own.y, own.z), slope = behind - before;
            n += 1.0f;
            w += a;
            t += b;
            s += slope;
            ww += a * a;
            tt += b * b;
            wt += a * b;
            ss += slope * slope;
        }
    const float inverse = 1.0f / fmax(n, 1.0f), noise = NOISE * NOISE;
    const float var_w = fmax(ww - w * w * inverse, 0.0f) * inverse, var_t = fmax(tt - t * t * inverse, 0.0f) * inverse;
    const float cov = fmax(wt - w * t * inverse, 0.0f) * inverse, slopes = ss - s * s * inverse;
    const float explained = fmin(cov * cov / fmax(var_w * var_t, noise * noise), 1.0f);
    const bool known = n >= LEAST_PIXELS && explained > CONFIRMED && slopes > 0.0f;
    rows[row * count + k] = known ? log2((var_w * (1.0f - explained) + noise) / (explained * slopes)) : NAN;
}
