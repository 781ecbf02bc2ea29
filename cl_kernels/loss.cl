// L1 + SSIM of a rendered context view against its photo, and what each pixel passes back (method section 5).
//
// SSIM is separable: tiles of TILE_W x TILE_H pixels with a halo of HALO go to local memory, each work-item then runs
// along RUN neighbours at a time, so that a value is read from local memory once for several windows.
//   ssim_forward    rendered, photo -> d SSIM / d (mean x, E[xx + yy], E[xy]) per channel
//   loss_backward   those three, blurred, + L1 -> upstream (G, h): dL/dalpha_i = G . c_i + h (order-free),
//                   (dL/dC, dL/dA) (alpha blend)
#include "rendered.clh"

#define HALO 5
#define TAPS 11
#define TILE_W 32
#define TILE_H 16
#define RUN 4
#define WIDE (TILE_W + 2 * HALO)
#define TALL (TILE_H + 2 * HALO)
#define C1 1e-4f
#define C2 9e-4f
#define LOSS_ONE 4294967296.0f           // 2^32: losses are summed as whole numbers, in any order

// 11 taps of a Gaussian with sigma 1.5, sum 1
__constant float WINDOW[TAPS] = {0.00102838f, 0.00759876f, 0.03600077f, 0.10936069f, 0.21300554f, 0.26601173f,
                                 0.21300554f, 0.10936069f, 0.03600077f, 0.00759876f, 0.00102838f};

bool window_inside(int x, int y, int width, int height)
{
    return x >= HALO && y >= HALO && x < width - HALO && y < height - HALO;
}

void sum_into(__local long *scratch, long value, __global long *sums)
{
    const int lane = get_local_id(0);
    scratch[lane] = value;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (lane == 0) {
        long sum = 0;
        for (int k = 0; k < LOSS_GROUP; ++k)
            sum += scratch[k];
        sums[get_group_id(1) * get_num_groups(0) + get_group_id(0)] = sum;
    }
}

__kernel __attribute__((reqd_work_group_size(LOSS_GROUP, 1, 1)))
void ssim_forward(__global const stored_t *rendered, __global const uchar4 *photo, int width, int height,
                  __global float *partials, __global long *losses)
{
    __local float xs[CHANNELS][TALL * WIDE], ys[CHANNELS][TALL * WIDE];
    __local float blurred[4][TALL * TILE_W];
#ifdef TRACK_LOSS
    __local long scratch[LOSS_GROUP];
    long loss = 0;
#endif
    const int lane = get_local_id(0), left = get_group_id(0) * TILE_W, top = get_group_id(1) * TILE_H;
    const int pixels = width * height;

    for (int t = lane; t < TALL * WIDE; t += LOSS_GROUP) {
        const int x = left + t % WIDE - HALO, y = top + t / WIDE - HALO;
        const bool inside = x >= 0 && y >= 0 && x < width && y < height;
        const int pixel = inside ? y * width + x : 0;
        const uchar4 p = photo[pixel];
        const Rendered r = load_rendered(rendered, pixel, p);
        const color_t reference = color_of(p);
        for (int c = 0; c < CHANNELS; ++c) {
            xs[c][t] = inside ? channel_of(r.color, c) : 0.0f;
            ys[c][t] = inside ? channel_of(reference, c) : 0.0f;
        }
    }
    barrier(CLK_LOCAL_MEM_FENCE);

    for (int c = 0; c < CHANNELS; ++c) {
        for (int t = lane; t < TALL * (TILE_W / RUN); t += LOSS_GROUP) {
            const int y = t / (TILE_W / RUN), x = (t % (TILE_W / RUN)) * RUN;
            float sums[4][RUN] = {{0.0f}};
            for (int j = 0; j < TAPS + RUN - 1; ++j) {
                const float a = xs[c][y * WIDE + x + j], b = ys[c][y * WIDE + x + j];
                const float squares = a * a + b * b, product = a * b;
                for (int k = 0; k < RUN; ++k)
                    if (j >= k && j - k < TAPS) {
                        const float w = WINDOW[j - k];
                        sums[0][k] += w * a;
                        sums[1][k] += w * b;
                        sums[2][k] += w * squares;
                        sums[3][k] += w * product;
                    }
            }
            for (int k = 0; k < RUN; ++k)
                for (int q = 0; q < 4; ++q)
                    blurred[q][y * TILE_W + x + k] = sums[q][k];
        }
        barrier(CLK_LOCAL_MEM_FENCE);

        for (int t = lane; t < TILE_W * (TILE_H / RUN); t += LOSS_GROUP) {
            const int x = t % TILE_W, y = t / TILE_W * RUN;
            float sums[4][RUN] = {{0.0f}};
            for (int j = 0; j < TAPS + RUN - 1; ++j)
                for (int q = 0; q < 4; ++q) {
                    const float value = blurred[q][(y + j) * TILE_W + x];
                    for (int k = 0; k < RUN; ++k)
                        if (j >= k && j - k < TAPS)
                            sums[q][k] += WINDOW[j - k] * value;
                }
            for (int k = 0; k < RUN; ++k) {
                const int column = left + x, row = top + y + k;
                if (column >= width || row >= height)
                    continue;
                float by_mean = 0.0f, by_squares = 0.0f, by_product = 0.0f;
                if (window_inside(column, row, width, height)) {
                    const float mx = sums[0][k], my = sums[1][k];
                    const float a1 = 2.0f * mx * my + C1, a2 = 2.0f * (sums[3][k] - mx * my) + C2;
                    const float b1 = mx * mx + my * my + C1;
                    const float b2 = fmax(sums[2][k] - mx * mx - my * my, 0.0f) + C2;
                    const float inverse = 1.0f / (b1 * b2), similarity = a1 * a2 * inverse;
                    by_squares = -similarity / b2;
                    by_product = 2.0f * a1 * inverse;
                    by_mean = 2.0f * my * a2 * inverse - 2.0f * mx * similarity / b1
                              - my * by_product - 2.0f * mx * by_squares;
#ifdef TRACK_LOSS
                    loss += convert_long_rte((1.0f - similarity) * LOSS_ONE);
#endif
                }
                __global float *out = partials + c * 3 * pixels + row * width + column;
                out[0] = by_mean;
                out[pixels] = by_squares;
                out[2 * pixels] = by_product;
            }
        }
        barrier(CLK_LOCAL_MEM_FENCE);
    }
#ifdef TRACK_LOSS
    sum_into(scratch, loss, losses);
#endif
}

__kernel __attribute__((reqd_work_group_size(LOSS_GROUP, 1, 1)))
void loss_backward(__global const stored_t *rendered, __global const uchar4 *photo, int width, int height,
                   __global const float *partials, __global const uint *seen, float l1_scale, float ssim_scale,
                   __global float *upstream, __global long *losses)
{
#ifdef SSIM
    __local float maps[3][TALL * WIDE];
    __local float blurred[3][TALL * TILE_W];
    __local float by_color[CHANNELS][TILE_H * TILE_W];
#endif
#ifdef TRACK_LOSS
    __local long scratch[LOSS_GROUP];
    long loss = 0;
#endif
    const int lane = get_local_id(0), left = get_group_id(0) * TILE_W, top = get_group_id(1) * TILE_H;

#ifdef SSIM
    const int pixels = width * height;
    for (int c = 0; c < CHANNELS; ++c) {
        for (int t = lane; t < TALL * WIDE; t += LOSS_GROUP) {
            const int x = left + t % WIDE - HALO, y = top + t / WIDE - HALO;
            const bool inside = x >= 0 && y >= 0 && x < width && y < height;
            const int pixel = c * 3 * pixels + (inside ? y * width + x : 0);
            for (int q = 0; q < 3; ++q)
                maps[q][t] = inside ? partials[pixel + q * pixels] : 0.0f;
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int t = lane; t < TALL * (TILE_W / RUN); t += LOSS_GROUP) {
            const int y = t / (TILE_W / RUN), x = (t % (TILE_W / RUN)) * RUN;
            for (int q = 0; q < 3; ++q) {
                float sums[RUN] = {0.0f};
                for (int j = 0; j < TAPS + RUN - 1; ++j) {
                    const float value = maps[q][y * WIDE + x + j];
                    for (int k = 0; k < RUN; ++k)
                        if (j >= k && j - k < TAPS)
                            sums[k] += WINDOW[j - k] * value;
                }
                for (int k = 0; k < RUN; ++k)
                    blurred[q][y * TILE_W + x + k] = sums[k];
            }
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int t = lane; t < TILE_W * (TILE_H / RUN); t += LOSS_GROUP) {
            const int x = t % TILE_W, y = t / TILE_W * RUN;
            float sums[3][RUN] = {{0.0f}};
            for (int j = 0; j < TAPS + RUN - 1; ++j)
                for (int q = 0; q < 3; ++q) {
                    const float value = blurred[q][(y + j) * TILE_W + x];
                    for (int k = 0; k < RUN; ++k)
                        if (j >= k && j - k < TAPS)
                            sums[q][k] += WINDOW[j - k] * value;
                }
            for (int k = 0; k < RUN; ++k) {
                const int column = min(left + x, width - 1), row = min(top + y + k, height - 1);
                const int pixel = row * width + column;
                const uchar4 p = photo[pixel];
                const float a = channel_of(load_rendered(rendered, pixel, p).color, c);
                const float b = channel_of(color_of(p), c);
                by_color[c][(y + k) * TILE_W + x] =
                    -ssim_scale * (sums[0][k] + 2.0f * a * sums[1][k] + b * sums[2][k]);
            }
        }
        barrier(CLK_LOCAL_MEM_FENCE);
    }
#endif

    for (int t = lane; t < TILE_W * TILE_H; t += LOSS_GROUP) {
        const int x = left + t % TILE_W, y = top + t / TILE_W;
        if (x >= width || y >= height)
            continue;
        const int pixel = y * width + x;
        const uchar4 p = photo[pixel];
        const Rendered r = load_rendered(rendered, pixel, p);
        const color_t residual = r.color - color_of(p);
        float weight = 1.0f;
#ifdef GRADIENT_WEIGHT
        weight *= gradient_weight(photo, x, y, width, height);
#endif
#ifdef UNSEEN_MASK
        if (seen)                          // the target's own view has no such mask
            weight *= (float)((seen[pixel >> 5] >> (pixel & 31)) & 1u);
#endif
        float mean_residual = 0.0f;
        float by[CHANNELS];
        float full_weight = weight;
#ifdef COVERAGE_WEIGHT
        full_weight *= r.coverage;
#endif
        for (int c = 0; c < CHANNELS; ++c) {
            const float e = channel_of(residual, c);
            mean_residual += fabs(e) * (1.0f / CHANNELS);
            by[c] = l1_scale * full_weight * (1.0f / CHANNELS) * ((e > 0.0f) - (e < 0.0f));
#ifdef SSIM
            by[c] += by_color[c][t];
#endif
            by[c] = r.live ? by[c] : 0.0f;
        }
        float by_coverage = 0.0f;
#ifdef COVERAGE_WEIGHT
        by_coverage = r.live ? l1_scale * weight * mean_residual : 0.0f;
#endif
#ifdef TRACK_LOSS
        loss += r.live ? convert_long_rte(full_weight * mean_residual * LOSS_ONE) : 0;
#endif
        // chain through the normalisation of the blend
        float last = by_coverage;
#if defined(ORDER_FREE) || defined(NORMALIZE)
#ifdef ORDER_FREE
        last = r.weight < 1.0f ? by_coverage : 0.0f;
#endif
        const float inverse = r.live ? 1.0f / r.weight : 0.0f;
        for (int c = 0; c < CHANNELS; ++c) {
            by[c] *= inverse;
            last -= by[c] * channel_of(r.color, c);
        }
#endif
#ifdef GREY
        vstore2((float2)(by[0], last), pixel, upstream);
#else
        vstore4((float4)(by[0], by[1], by[2], last), pixel, upstream);
#endif
    }
#ifdef TRACK_LOSS
    sum_into(scratch, loss, losses);
#endif
}
