// What each pixel of a rendered context view passes back (method section 5): the derivatives of SSIM, blurred, and L1.
//   v_rendered (G, h): dL/dalpha_i = G . c_i + h (order-free), or (dL/dC, dL/dA) (alpha blend)
#include "window.clh"

#define SUMS (3 * TILE_H * STRIDE)                      // of a channel: three planes

#ifdef SSIM
// Vertical windows of the three partials of each channel, over the windows that hold a pixel of the tile.
void gather_down(__global const int *partials, int left, int top, int width, int height, int pitch, __local float *sums)
{
    const int plane = pitch * height;
    for (int t = get_local_id(0); t < CHANNELS * (TILE_H / RUN) * ACROSS; t += TILE_GROUP) {
        const int y = t / ACROSS % (TILE_H / RUN) * RUN, x = span_start(t % ACROSS, COLUMNS, WIDE);
        const int c = t / (TILE_H / RUN * ACROSS), column = left + x - HALO, row = top + y - HALO;
        columns_t sum[3][RUN];
        UNROLL for (int k = 0; k < RUN; ++k)
            sum[0][k] = sum[1][k] = sum[2][k] = ZERO;
        UNROLL for (int j = 0; j < TAPS + RUN - 1; ++j) {
            const mask_t there = row + j >= 0 && row + j < height - HALO ? -1 : 0;       // read all the same
            const int place = c * plane + clamp(row + j, 0, height - HALO - 1) * pitch + min(column, width - COLUMNS);
            LOAD_TWO(int, partials + 2 * place, one, other)
            const columns_t value[3] = {FIRST(one, other), THIRD(one, other), SECOND(one, other)};
            UNROLL for (int q = 0; q < 3; ++q)
                UNROLL for (int k = 0; k < RUN; ++k)
                    if (j >= k && j - k < TAPS)
                        sum[q][k] += WINDOW[j - k] * select(ZERO, value[q], there);
        }
        const mask_t lanes = column + LANE_NUMBERS, inside = (lanes >= 0) & (lanes < width - HALO);
        UNROLL for (int k = 0; k < RUN; ++k)
            UNROLL for (int q = 0; q < 3; ++q)
                STORE_COLUMNS(select(ZERO, sum[q][k], inside),
                              sums + c * SUMS + q * TILE_H * STRIDE + (y + k) * STRIDE + x);
    }
}

// Windows across take the place of what they are made of: a window begins at its own place and reads to the right, so
// that of a row only what is done later must wait.
void gather_across(__local float *sums)
{
    for (int from = 0; from < TILE_H * CHUNKS; from += TILE_GROUP) {
        const int t = from + get_local_id(0), place = t / CHUNKS * STRIDE + t % CHUNKS * LANES;
#if TILE_GROUP == 1
        KEEP_LOOP for (int q = 0; q < 3 * CHANNELS; ++q)
            STORE_ROW(blur_across(sums + q * TILE_H * STRIDE + place), sums + q * TILE_H * STRIDE + place);
#else
        lanes_t across[3 * CHANNELS];
        UNROLL for (int q = 0; q < 3 * CHANNELS; ++q)
            if (t < TILE_H * CHUNKS)
                across[q] = blur_across(sums + q * TILE_H * STRIDE + place);
        barrier(CLK_LOCAL_MEM_FENCE);
        UNROLL for (int q = 0; q < 3 * CHANNELS; ++q)
            if (t < TILE_H * CHUNKS)
                STORE_ROW(across[q], sums + q * TILE_H * STRIDE + place);
#endif
    }
}

// dSSIM/dx of channel c at a place of the tile.
columns_t dssim_dcolor(__local const float *sums, int c, int place, columns_t x, columns_t y)
{
    __local const float *at = sums + c * SUMS + place;
    return LOAD_COLUMNS(at) + x * LOAD_COLUMNS(at + TILE_H * STRIDE)
           + (y - x) * LOAD_COLUMNS(at + 2 * TILE_H * STRIDE);
}
#endif

// w of L1 without coverage: texture and unseen mask.
columns_t pixel_weight(__global const uchar4 *photo, const Rendered r, __global const uint *seen, int x, int y,
                       int width, int height)
{
    const int pixel = y * width + x;
    columns_t weight = 1.0f;
#ifdef GRADIENT_WEIGHT
    columns_t right[CHANNELS], below[CHANNELS];
    load_photo(photo, pixel + 1, right);                     // what is after the last one is read, and not used
    load_photo(photo, y + 1 < height ? pixel + width : pixel, below);
    weight *= gradient_weight(r.photo, right, below, x + 1 + LANE_NUMBERS < width);
#endif
#ifdef UNSEEN_MASK
    if (seen) {                        // the target's own view has no such mask
        const ulong bits = ((ulong)seen[(pixel >> 5) + 1] << 32 | seen[pixel >> 5]) >> (pixel & 31);
        weight *= TO_COLUMNS(((mask_t)((int)bits) >> LANE_NUMBERS) & 1);
    }
#endif
    return weight;
}

// Chain through the normalisation of the blend, and store what each participant needs (method sections 4.1 and 4.2):
// order-free G = g / max(1, S), h = -G . mean, plus dL/dA where S < 1; of C / A G = g / A, h = dL/dA - G . (C / A).
void store_v_rendered(const Rendered r, columns_t v_color[CHANNELS], columns_t v_coverage, __global float *out)
{
#ifdef ORDER_FREE
    columns_t last = select(ZERO, v_coverage, r.weight < 1.0f);
    // how much of a pixel is covered has no gradient: against the average of the colours, not what the photo filled up
    const columns_t inverse = select(ZERO, 1.0f / fmax(r.weight, 1.0f), r.live);
    const columns_t filled = select(ZERO, 1.0f / fmin(fmax(r.weight, 1e-12f), 1.0f), r.live);
    for (int c = 0; c < CHANNELS; ++c) {
        v_color[c] *= inverse;
        last -= v_color[c] * (r.photo[c] + filled * (r.color[c] - r.photo[c]));
    }
#else
    columns_t last = v_coverage;
#endif
#ifdef NORMALIZE
    const columns_t inverse = select(ZERO, 1.0f / fmax(r.weight, ALPHA_SEEN), r.live);
    for (int c = 0; c < CHANNELS; ++c) {
        v_color[c] *= inverse;
        last -= v_color[c] * r.color[c];
    }
#endif
#ifdef GREY
    STORE_TWO(v_color[0], last, out);
#else
    STORE_FOUR(v_color[0], v_color[1], v_color[2], last, out);
#endif
}

// |e| and its slope: quadratic up to `huber` (0: plain L1, its inverse is large), constant beyond 1/4 of `robust`.
columns_t residual_size(columns_t e, float huber, float inverse_huber, float robust, columns_t *slope)
{
    columns_t size = fabs(e);
#ifdef ROBUST
    size = fmin(size, 0.25f * robust);
#endif
    const columns_t inner = fmin(size, huber);
    size += inner * (inner * (0.5f * inverse_huber) - 1.0f);
    *slope = clamp(e * inverse_huber, -1.0f, 1.0f);
#ifdef ROBUST
    *slope = select(ZERO, *slope, fabs(e) <= 0.25f * robust);
#endif
    return size;
}

#ifdef TRACK_LOSS
// Whole numbers of the lanes that are new: not repeated from the tile before.
long whole_loss(columns_t loss, int repeated)
{
    float lane[COLUMNS];
    long sum = 0;
    STORE_COLUMNS(loss, lane);
    for (int k = max(repeated, 0); k < COLUMNS; ++k)
        sum += convert_long_rte(lane[k] * TILE_ONE);
    return sum;
}
#endif

__kernel TILE_LOOP
void loss_backward(__global stored_t *rendered, __global const uchar4 *photo, int width, int height, int pitch,
                   __global const int *partials, __global const uint *seen, float huber, float inverse_huber,
                   float robust, float l1_scale, float ssim_scale, __global float *v_rendered, float loss_scale,
                   __global uint *total)
{
    const int left = span_start(get_group_id(0), TILE_W, width), top = span_start(get_group_id(1), TILE_H, height);
#ifdef SSIM
    __local float sums[CHANNELS * SUMS] __attribute__((aligned(16)));
    if (ssim_scale > 0.0f) {
        gather_down(partials + 2 * MARGIN, left, top, width, height, pitch, sums);
        barrier(CLK_LOCAL_MEM_FENCE);
        gather_across(sums);
        barrier(CLK_LOCAL_MEM_FENCE);
    }
#endif
#ifdef TRACK_LOSS
    __local long scratch[TILE_GROUP];
    long loss = 0;
#endif
    for (int t = get_local_id(0); t < TILE_H * TILE_ACROSS; t += TILE_GROUP) {
        const int row = t / TILE_ACROSS, column = t % TILE_ACROSS * COLUMNS;
        const int x = left + column, y = top + row, pixel = y * width + x;
        if (x >= width || y >= height)
            continue;
        const Rendered r = load_rendered(rendered, photo, pixel);
#if defined(ORDER_FREE) && ONE_PIXEL
        *(__global PAINT(uint) *)(rendered + pixel * (CHANNELS + 1)) = 0;      // no other reads it: composite.cl
#endif
        const columns_t weight = pixel_weight(photo, r, seen, x, y, width, height);
#ifdef COVERAGE_WEIGHT
        const columns_t full_weight = weight * r.coverage;
#else
        const columns_t full_weight = weight;
#endif
        columns_t v_color[CHANNELS], mean_residual = ZERO;
        for (int c = 0; c < CHANNELS; ++c) {
            columns_t slope;
            const columns_t size = residual_size(r.color[c] - r.photo[c], huber, inverse_huber, robust, &slope);
            mean_residual += size * (1.0f / CHANNELS);
            v_color[c] = l1_scale * (1.0f / CHANNELS) * full_weight * slope;
#ifdef SSIM
            if (ssim_scale > 0.0f)
                v_color[c] -= ssim_scale * dssim_dcolor(sums, c, row * STRIDE + column, r.color[c], r.photo[c]);
#endif
            v_color[c] = select(ZERO, v_color[c], r.live);
        }
#ifdef COVERAGE_WEIGHT
        const columns_t v_coverage = select(ZERO, l1_scale * weight * mean_residual, r.live);
#else
        const columns_t v_coverage = ZERO;
#endif
        store_v_rendered(r, v_color, v_coverage, v_rendered + pixel * (CHANNELS + 1));
#ifdef TRACK_LOSS
        if (y >= (int)get_group_id(1) * TILE_H)
            loss += whole_loss(select(ZERO, full_weight * mean_residual, r.live), (int)get_group_id(0) * TILE_W - x);
#endif
    }
#ifdef TRACK_LOSS
    add_losses(scratch, loss, loss_scale, total);
#endif
}
