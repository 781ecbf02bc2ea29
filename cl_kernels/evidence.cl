// What the photos say of each depth, apart from the loss that was minimised: patches of the target against the
// context photos warped through the depth map (method section 7).
//
//   warp_photo   a context photo seen from the target: grey value and its slope by the depth, per target pixel
//   weigh        5x5 patches of it against the target: correlation, and how sharply it fixes the depth
//   sum_window   1 - correlation and views of one line of pixels around each pixel, by rows and then by columns
//   decide       which refined depths are kept
//   feather      no seams between those and the others
#include "camera.clh"
#include "photo.clh"

#define PATCH 2                      // half the width of a patch
#define LEAST_PIXELS 6               // of a patch must be visible
#define NOISE (1.0f / 255.0f)        // of a photo: what a residual never falls below
#define LEAST_POSSIBLE 0.3f          // below this a patch is all noise
#define UNSEEN -1.0f
#define CHANCE 0.02f                 // growth of 1 - correlation in a photo, mean around a pixel, that says nothing

__kernel void warp_photo(__global const float *depth, __constant float *cameras, int view, float threshold,
                         __global const uint *z_first, __global const uchar4 *photo,
                         __global float2 *warped)                  // [H, W] grey 0 to 1 or UNSEEN, slope by depth
{
    const Camera target = load_camera(cameras, 0), context = load_camera(cameras, view);
    EACH_PIXEL(column, row, i, target.width, target.height)
    const float d = depth[i];
    warped[i] = (float2)(UNSEEN, 0.0f);
    if (!(d > 0.0f))
        return;
    const float3 q = turned_ray(target, context, column, row), m = project_ray(context, q, d);
    const float u = m.x - 0.5f, v = m.y - 0.5f, inverse_z = 1.0f / m.z, zz = inverse_z * inverse_z;
    if (!(m.z > NEAR && u >= 0.0f && v >= 0.0f && u <= context.width - 1.001f && v <= context.height - 1.001f))
        return;
    const int x = (int)u, y = (int)v, pixel = y * context.width + x;
    const float a = u - x, b = v - y;
#ifdef OCCLUSION
    if (m.z > as_float(z_first[(int)(v + 0.5f) * context.width + (int)(u + 0.5f)]) + threshold)
        return;
#endif
    const int right = x + 1 < context.width ? 1 : 0, below = y + 1 < context.height ? context.width : 0;
    const uchar4 p00 = photo[pixel], p10 = photo[pixel + right], p01 = photo[pixel + below];
    const uchar4 p11 = photo[pixel + right + below];
    if (p00.w == 0 || p10.w == 0 || p01.w == 0 || p11.w == 0)
        return;
    const float g00 = grey_of(p00), g10 = grey_of(p10), g01 = grey_of(p01), g11 = grey_of(p11);
    const float value = (1 - b) * ((1 - a) * g00 + a * g10) + b * ((1 - a) * g01 + a * g11);
    const float slope_u = (1 - b) * (g10 - g00) + b * (g11 - g01), slope_v = (1 - a) * (g01 - g00) + a * (g11 - g10);
    const float2 moved = mean_slope(context, q);
    const float slope = slope_u * context.fx * moved.x * zz + slope_v * context.fy * moved.y * zz;
    warped[i] = (float2)(value, slope);
}

// evidence per pixel: sum of 1 - correlation, number of views, sum of information (1 / variance of the depth)
//
// noise_variance: of the photos' noise beyond NOISE. A correlation is taken as a share of what that much noise lets a
// perfect match have; looking up between pixels leaves 4/9 of it. Without it two flat patches match; with it, nothing
// is known of them.
__kernel void weigh(__global const float2 *warped, __global const uchar4 *target_photo, int width, int height,
                    float noise_variance, __global float *evidence)     // [H, W, 3], added
{
    EACH_PIXEL(column, row, i, width, height)
    if (warped[i].x == UNSEEN)
        return;
    float n = 0.0f, w = 0.0f, t = 0.0f, s = 0.0f, ww = 0.0f, tt = 0.0f, wt = 0.0f, ss = 0.0f;
    const float origin = warped[i].x, middle = grey_of(target_photo[i]);
    for (int y = max(row - PATCH, 0); y <= min(row + PATCH, height - 1); ++y)
        for (int x = max(column - PATCH, 0); x <= min(column + PATCH, width - 1); ++x) {
            const float2 seen = warped[y * width + x];
            if (seen.x == UNSEEN)
                continue;
            const float a = seen.x - origin, b = grey_of(target_photo[y * width + x]) - middle;
            n += 1.0f;
            w += a;
            t += b;
            s += seen.y;
            ww += a * a;
            tt += b * b;
            wt += a * b;
            ss += seen.y * seen.y;
        }
    if (n < LEAST_PIXELS)
        return;
    const float inverse = 1.0f / n, noise = NOISE * NOISE;
    const float var_w = fmax(ww - w * w * inverse, 0.0f) * inverse, var_t = fmax(tt - t * t * inverse, 0.0f) * inverse;
    const float cov = (wt - w * t * inverse) * inverse;
    const float flat = fmax(noise - noise_variance, 1e-9f);
    const float clear_w = 1.0f - 4.0f / 9 * noise_variance / (var_w + flat);
    const float clear_t = 1.0f - noise_variance / (var_t + flat);
    const float possible = fmax(sqrt(fmax(clear_w, 0.0f) * fmax(clear_t, 0.0f)), LEAST_POSSIBLE);
    const float correlation = (cov + flat) / sqrt((var_w + flat) * (var_t + flat)) / possible;
    const float share = fmin(fmax(cov, 0.0f) / sqrt(fmax(var_w * var_t, noise * noise)), 1.0f);
    const float explained = share * share, unexplained = var_w * (1.0f - explained) + noise;
    float3 e = vload3(i, evidence);
    e.x += 1.0f - correlation;
    e.y += 1.0f;
    e.z += explained * fmax(ss - s * s * inverse, 0.0f) / unexplained;
    vstore3(e, i, evidence);
}

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

// before, after: evidence under the initial and the refined depth; around: that of the surroundings. A depth goes back
// to the initial one where its patches match worse than before, where the photos do not show the same thing around it
// (moving content, wrong poses, no texture), where it moved too far, and where no other view sees it.
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
    for (int y = max(row - SEAM, 0); y <= min(row + SEAM, height - 1); ++y)
        for (int x = max(column - SEAM, 0); x <= min(column + SEAM, width - 1); ++x) {
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
