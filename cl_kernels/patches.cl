// What the photos say of each depth, apart from the loss that was minimised: patches of the target against the
// context photos warped through the depth map (method section 7).
// warped: [2, H, W] of a context photo seen from the target, grey 0 to 1 or UNSEEN, and its slope by the depth;
// grey: [H, W] of the target
#include "camera.clh"
#include "photo.clh"

#define PATCH 2                      // half the width of a patch
#define LEAST_PIXELS 6               // of a patch must be visible
#define NOISE (1.0f / 255.0f)        // of a photo: what a residual never falls below
#define LEAST_POSSIBLE 0.3f          // below this a patch is all noise
#define UNSEEN -1.0f                 // grey value where the context photo does not show the pixel

// Grey values of scattered pixels; returns where they are valid.
mask_t pick_grey(__global const uchar4 *photo, mask_t pixels, columns_t *grey)
{
#if ONE_PIXEL
    const uchar4 picked = photo[pixels];
    const float red = picked.x, green = picked.y, blue = picked.z, valid = picked.w;
#else
    int pixel[COLUMNS];
    uchar4 picked[COLUMNS];
    STORE_COLUMNS(pixels, pixel);
    for (int k = 0; k < COLUMNS; ++k)
        picked[k] = photo[pixel[k]];
    LOAD_FOUR(uchar, (const uchar *)picked, reds, greens, blues, valids)
    const columns_t red = TO_COLUMNS(reds), green = TO_COLUMNS(greens), blue = TO_COLUMNS(blues);
    const columns_t valid = TO_COLUMNS(valids);
#endif
    *grey = LUMA(red, green, blue) * (1.0f / 255.0f);
    return valid != ZERO;
}

__kernel void warp_photo(__global const float *depth, __constant float *cameras, int view, float depth_threshold,
                         __global const uint *z_first, __global const uchar4 *photo,
                         __global const uchar4 *target_photo, __global float *warped, __global float *grey)
{
    const Camera target = load_camera(cameras, 0), context = load_camera(cameras, view);
    const int row = get_global_id(1), width = context.width, height = context.height;
    if (row >= target.height)
        return;
    EACH_VECTOR(item, target.width) {
        const int column = span_start(item, COLUMNS, target.width), i = row * target.width + column;
        const columns_t d = LOAD_COLUMNS(depth + i);
        columns_t q[3], own[3], g00, g10, g01, g11;
        turned_rays(target, context, column, row, q);
        const columns_t z = d * q[2] + context.t.z, inverse_z = 1.0f / z;
        const columns_t u = context.fx * (d * q[0] + context.t.x) * inverse_z + context.cx - 0.5f;
        const columns_t v = context.fy * (d * q[1] + context.t.y) * inverse_z + context.cy - 0.5f;
        mask_t seen = (d > 0.0f) & (z > NEAR) & (u >= 0.0f) & (v >= 0.0f) & (u <= width - 1.001f)
                      & (v <= height - 1.001f);
        const columns_t inside_u = select(ZERO, u, seen), inside_v = select(ZERO, v, seen);
        const mask_t x = TO_WHOLE(inside_u), y = TO_WHOLE(inside_v), pixel = y * width + x;
        const columns_t a = inside_u - TO_COLUMNS(x), b = inside_v - TO_COLUMNS(y);
#ifdef OCCLUSION
        const mask_t nearest = TO_WHOLE(inside_v + 0.5f) * width + TO_WHOLE(inside_u + 0.5f);
        seen &= z <= pick((__global const float *)z_first, nearest) + depth_threshold;
#endif
        const mask_t right = min(x + 1, (mask_t)(width - 1)) - x;
        const mask_t below = (min(y + 1, (mask_t)(height - 1)) - y) * width;
        seen &= pick_grey(photo, pixel, &g00) & pick_grey(photo, pixel + right, &g10)
                & pick_grey(photo, pixel + below, &g01) & pick_grey(photo, pixel + right + below, &g11);
        const columns_t value = BETWEEN(a, b, g00, g10, g01, g11);
        const columns_t slope_u = (1 - b) * (g10 - g00) + b * (g11 - g01);
        const columns_t slope_v = (1 - a) * (g01 - g00) + a * (g11 - g10);
        const columns_t slope = slope_u * context.fx * MEAN_SLOPE(q[0], q[2], context.t.x, context.t.z)
                                + slope_v * context.fy * MEAN_SLOPE(q[1], q[2], context.t.y, context.t.z);
        STORE_COLUMNS(select((columns_t)UNSEEN, value, seen), warped + i);
        STORE_COLUMNS(select(ZERO, slope * inverse_z * inverse_z, seen), warped + target.width * target.height + i);
        load_rgb(target_photo, i, own);
        STORE_COLUMNS(LUMA(own[0], own[1], own[2]), grey + i);
    }
}

// evidence per pixel: sum of 1 - correlation, number of views, sum of information (1 / variance of the depth)
//
// noise_variance: of the photos' noise beyond NOISE. A correlation is taken as a share of what that much noise lets a
// perfect match have; looking up between pixels leaves 4/9 of it. Without it two flat patches match; with it, nothing
// is known of them. floor_share: of NOISE, what counts in a residual.
__kernel void weigh(__global const float *warped, __global const float *grey, int width, int height,
                    float noise_variance, float floor_share, __global float *evidence)     // [H, W, 3], added
{
    const int row = get_global_id(1);
    if (row >= height)
        return;
    EACH_VECTOR(item, width) {
        const int column = span_start(item, COLUMNS, width), i = row * width + column;
        const columns_t origin = LOAD_COLUMNS(warped + i), middle = LOAD_COLUMNS(grey + i);
        columns_t n = ZERO, w = ZERO, t = ZERO, s = ZERO, ww = ZERO, tt = ZERO, wt = ZERO, ss = ZERO;
        for (int y = max(row - PATCH, 0); y <= min(row + PATCH, height - 1); ++y)
            for (int x = column - PATCH; x <= column + PATCH; ++x) {
                const columns_t value = load_around(warped, x, y, width, height);
                const mask_t lanes = x + LANE_NUMBERS, seen = (value != UNSEEN) & (lanes >= 0) & (lanes < width);
                const columns_t a = select(ZERO, value - origin, seen);
                const columns_t b = select(ZERO, load_around(grey, x, y, width, height) - middle, seen);
                const columns_t slope = load_around(warped + width * height, x, y, width, height);    // 0 where unseen
                n += select(ZERO, (columns_t)1.0f, seen);
                w += a;
                t += b;
                s += slope;
                ww += a * a;
                tt += b * b;
                wt += a * b;
                ss += slope * slope;
            }
        const float noise = NOISE * NOISE, flat = fmax(noise - noise_variance, 1e-9f);
        const columns_t inverse = 1.0f / fmax(n, 1.0f);
        const columns_t var_w = fmax(ww - w * w * inverse, 0.0f) * inverse;
        const columns_t var_t = fmax(tt - t * t * inverse, 0.0f) * inverse;
        const columns_t cov = (wt - w * t * inverse) * inverse;
        const columns_t clear_w = 1.0f - 4.0f / 9 * noise_variance / (var_w + flat);
        const columns_t clear_t = 1.0f - noise_variance / (var_t + flat);
        const columns_t possible = fmax(sqrt(fmax(clear_w, 0.0f) * fmax(clear_t, 0.0f)), LEAST_POSSIBLE);
        const columns_t correlation = (cov + flat) / sqrt((var_w + flat) * (var_t + flat)) / possible;
        const columns_t share = fmin(fmax(cov, 0.0f) / sqrt(fmax(var_w * var_t, noise * noise)), 1.0f);
        const columns_t explained = share * share, unexplained = var_w * (1.0f - explained) + floor_share * noise;
        const mask_t known = (origin != UNSEEN) & (n >= LEAST_PIXELS) & (column + LANE_NUMBERS >= item * COLUMNS);
        float found[3][COLUMNS];
        STORE_COLUMNS(select(ZERO, 1.0f - correlation, known), found[0]);
        STORE_COLUMNS(select(ZERO, (columns_t)1.0f, known), found[1]);
        STORE_COLUMNS(select(ZERO, explained * fmax(ss - s * s * inverse, 0.0f) / unexplained, known), found[2]);
        for (int k = 0; k < COLUMNS; ++k)
            for (int part = 0; part < 3; ++part)
                evidence[3 * (i + k) + part] += found[part][k];
    }
}
