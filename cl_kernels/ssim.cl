// SSIM of a rendered context view and its photo (method section 5): for each window that lies inside the image, the
// derivatives by its means: d SSIM / d (mean x, E[xx + yy], E[xy]), per channel. A window is named by its first pixel.
#include "window.clh"

#define C1 1e-4f
#define C2 9e-4f

#define SUMS (4 * TILE_H * STRIDE)                      // of a channel: four planes

// Vertical windows of x, y, xx + yy and xy of each channel, x rendered and y of the photo.
void blur_down(__global const stored_t *rendered, __global const uchar4 *photo, int left, int top, int width,
               int height, __local float *sums)
{
    for (int t = get_local_id(0); t < (TILE_H / RUN) * ACROSS; t += LOSS_GROUP) {
        const int y = t / ACROSS * RUN, x = span_start(t % ACROSS, COLUMNS, WIDE);
        columns_t sum[CHANNELS][4][RUN];
#pragma unroll
        for (int k = 0; k < RUN; ++k)
#pragma unroll
            for (int c = 0; c < CHANNELS; ++c)
                sum[c][0][k] = sum[c][1][k] = sum[c][2][k] = sum[c][3][k] = ZERO;
#pragma unroll
        for (int j = 0; j < TAPS + RUN - 1; ++j) {
            const int pixel = min(top + y + j, height - 1) * width + min(left + x, width - COLUMNS);
            const Rendered r = load_rendered(rendered, photo, pixel);
#pragma unroll
            for (int c = 0; c < CHANNELS; ++c) {
                const columns_t a = r.color[c], b = r.photo[c], squares = a * a + b * b, product = a * b;
#pragma unroll
                for (int k = 0; k < RUN; ++k)
                    if (j >= k && j - k < TAPS) {
                        const float w = WINDOW[j - k];
                        sum[c][0][k] += w * a;
                        sum[c][1][k] += w * b;
                        sum[c][2][k] += w * squares;
                        sum[c][3][k] += w * product;
                    }
            }
        }
#pragma unroll
        for (int k = 0; k < RUN; ++k)
#pragma unroll
            for (int c = 0; c < CHANNELS; ++c)
#pragma unroll
                for (int q = 0; q < 4; ++q)
                    STORE_COLUMNS(sum[c][q][k], sums + c * SUMS + (q * TILE_H + y + k) * STRIDE + x);
    }
}

// SSIM of LANES windows, and its derivatives to three planes from `out` on.
lanes_t similarity(lanes_t mx, lanes_t my, lanes_t squares, lanes_t product, __global float *out, int plane)
{
    const lanes_t a2 = 2.0f * (product - mx * my) + C2;
#ifdef STRUCTURE
    const lanes_t a1 = 1.0f, b1 = 1.0f;      // without the luminance term: a local offset of brightness is not seen
#else
    const lanes_t a1 = 2.0f * mx * my + C1, b1 = mx * mx + my * my + C1;
#endif
    const lanes_t b2 = fmax(squares - mx * mx - my * my, 0.0f) + C2;
    const lanes_t inverse = 1.0f / (b1 * b2), similar = a1 * a2 * inverse;
    const lanes_t by_squares = -similar * b1 * inverse, by_product = 2.0f * a1 * inverse;
#ifdef STRUCTURE
    const lanes_t by_mean = -my * by_product - 2.0f * mx * by_squares;
#else
    const lanes_t by_mean = 2.0f * (my * a2 * inverse - mx * similar * b2 * inverse) - my * by_product
                            - 2.0f * mx * by_squares;
#endif
#ifdef ROBUST
    const JOIN(int, LANES) kept = similar >= 1.0f - ROBUST;
#define KEPT(x) select((lanes_t)0.0f, x, kept)
#else
#define KEPT(x) (x)
#endif
    STORE_LANES(KEPT(by_mean), out);
    STORE_LANES(KEPT(by_squares), out + plane);
    STORE_LANES(KEPT(by_product), out + 2 * plane);
#ifdef ROBUST
    return fmax(similar, 1.0f - ROBUST);
#else
    return similar;
#endif
}

// 1 - SSIM as whole numbers, of those lanes that are new: not repeated, inside the image.
long dissimilarity(lanes_t similar, int first, int from, int end)
{
    float lane[LANES];
    long sum = 0;
    JOIN(vstore, LANES)(similar, 0, lane);
    for (int k = 0; k < LANES; ++k)
        if (first + k >= from && first + k < end)
            sum += convert_long_rte((1.0f - lane[k]) * LOSS_ONE);
    return sum;
}

__kernel TILE_LOOP
void ssim_forward(__global const stored_t *rendered, __global const uchar4 *photo, int width, int height, int pitch,
                  __global float *partials, __global long *losses)
{
    __local float sums[CHANNELS * SUMS] __attribute__((aligned(16)));
#ifdef TRACK_LOSS
    __local long scratch[LOSS_GROUP];
    long loss = 0;
#endif
    const int columns = width - HALO, rows = height - HALO, plane = pitch * height;
    const int left = tile_start(get_group_id(0), TILE_W, columns), top = get_group_id(1) * TILE_H;
    blur_down(rendered, photo, left, top, width, height, sums);
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int t = get_local_id(0); t < CHANNELS * TILE_H * CHUNKS; t += LOSS_GROUP) {
        const int c = t / (TILE_H * CHUNKS), y = t / CHUNKS % TILE_H, x = span_start(t % CHUNKS, LANES, TILE_W);
        const int row = top + y;
        if (row >= rows || left + x >= columns)
            continue;
        __local const float *at = sums + c * SUMS + y * STRIDE + x;
        __global float *out = partials + MARGIN + c * 3 * plane + row * pitch + left + x;
        const lanes_t similar = similarity(
            blur_across(at), blur_across(at + TILE_H * STRIDE), blur_across(at + 2 * TILE_H * STRIDE),
            blur_across(at + 3 * TILE_H * STRIDE), out, plane);
#ifdef TRACK_LOSS
        const int from = max((int)get_group_id(0) * TILE_W, left + t % CHUNKS * LANES);
        loss += dissimilarity(similar, left + x, from, columns);
#endif
    }
#ifdef TRACK_LOSS
    sum_into(scratch, loss, losses);
#endif
}
