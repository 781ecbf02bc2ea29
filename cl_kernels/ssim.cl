// SSIM of a rendered context view and its photo (method section 5): for each window that lies inside the image, what
// its pixels (x, y) make its derivative by x of, A + E x + C (y - x), per channel. A window's name is its first pixel.
#include "window.clh"

#define C1 1e-4f                         // 0.01^2 and 0.03^2, for colours of 0 to 1 (Wang et al. 2004)
#define C2 9e-4f

// 8-bit photos fit into bytes; grey ones are no longer whole numbers.
#ifdef GREY
typedef float shade_t;
#define LOAD_SHADES(p) LOAD_COLUMNS(p)
#define STORE_SHADES(v, p) STORE_COLUMNS(v, p)
#elif ONE_PIXEL
typedef uchar shade_t;
#define LOAD_SHADES(p) (*(p) * (1.0f / 255.0f))
#define STORE_SHADES(v, p) (*(p) = convert_uchar_rte((v) * 255.0f))
#else
typedef uchar shade_t;
#define LOAD_SHADES(p) (TO_COLUMNS(LOAD_COLUMNS(p)) * (1.0f / 255.0f))
#define STORE_SHADES(v, p) STORE_COLUMNS(JOIN(JOIN(convert_uchar, COLUMNS), _rte)((v) * 255.0f), p)
#endif

// The tile's colours, x rendered and y of the photo, to local memory.
void load_tile(__global const stored_t *rendered, __global const uchar4 *photo, int left, int top, int width,
               int height, __local float *xs, __local shade_t *ys)
{
    for (int t = get_local_id(0); t < TALL * ACROSS; t += TILE_GROUP) {
        const int y = t / ACROSS, x = span_start(t % ACROSS, COLUMNS, WIDE), place = y * STRIDE + x;
        const int pixel = min(top + y, height - 1) * width + min(left + x, width - COLUMNS);
        const Rendered r = load_rendered(rendered, photo, pixel);
        for (int c = 0; c < CHANNELS; ++c) {
            STORE_COLUMNS(r.color[c], xs + c * TALL * STRIDE + place);
            STORE_SHADES(r.photo[c], ys + c * TALL * STRIDE + place);
        }
    }
}

// Vertical windows of x, y, xx + yy and xy.
void blur_down(__local const float *xs, __local const shade_t *ys, __local float *sums)
{
    for (int t = get_local_id(0); t < (TILE_H / RUN) * ACROSS; t += TILE_GROUP) {
        const int y = t / ACROSS * RUN, x = span_start(t % ACROSS, COLUMNS, WIDE), place = y * STRIDE + x;
        columns_t sum_x[RUN], sum_y[RUN], sum_squares[RUN], sum_product[RUN];
        UNROLL for (int k = 0; k < RUN; ++k)
            sum_x[k] = sum_y[k] = sum_squares[k] = sum_product[k] = ZERO;
        UNROLL for (int j = 0; j < TAPS + RUN - 1; ++j) {
            const columns_t a = LOAD_COLUMNS(xs + place + j * STRIDE), b = LOAD_SHADES(ys + place + j * STRIDE);
            const columns_t squares = a * a + b * b, product = a * b;
            UNROLL for (int k = 0; k < RUN; ++k)
                if (j >= k && j - k < TAPS) {
                    const float w = WINDOW[j - k];
                    sum_x[k] += w * a;
                    sum_y[k] += w * b;
                    sum_squares[k] += w * squares;
                    sum_product[k] += w * product;
                }
        }
        UNROLL for (int k = 0; k < RUN; ++k) {
            __local float *out = sums + place + k * STRIDE;
            STORE_COLUMNS(sum_x[k], out);
            STORE_COLUMNS(sum_y[k], out + TILE_H * STRIDE);
            STORE_COLUMNS(sum_squares[k], out + 2 * TILE_H * STRIDE);
            STORE_COLUMNS(sum_product[k], out + 3 * TILE_H * STRIDE);
        }
    }
}

// SSIM of LANES windows, and A, E, C to `out`. With C = d/dE[xy], E = C + 2 d/dE[xx + yy] and
// A = d/d(mean x), no sum of them cancels: their first 21 bits are enough.
lanes_t similarity(lanes_t mx, lanes_t my, lanes_t squares, lanes_t product, float robust, __global int *out)
{
    const lanes_t a2 = 2.0f * (product - mx * my) + C2;
#ifdef STRUCTURE
    const lanes_t a1 = 1.0f, b1 = 1.0f;      // without the luminance term: a local offset of brightness is not seen
#else
    const lanes_t a1 = 2.0f * mx * my + C1, b1 = mx * mx + my * my + C1;
#endif
    const lanes_t b2 = fmax(squares - mx * mx - my * my, 0.0f) + C2;
    const lanes_t inverse = 1.0f / (b1 * b2), similar = a1 * a2 * inverse;
    const lanes_t v_product = 2.0f * a1 * inverse, v_both = v_product * (b2 - a2) * b1 * inverse;
#ifdef STRUCTURE
    const lanes_t v_mean = (mx - my) * v_product - mx * v_both;
#else
    const lanes_t luminance = 2.0f * a2 * b2 * inverse * inverse * (my * (mx + my) + C1);
    const lanes_t v_mean = (mx - my) * (v_product - luminance) - mx * v_both;
#endif
#ifdef ROBUST
    const JOIN(int, LANES) kept = similar >= 1.0f - robust;
#define KEPT(x) select((lanes_t)0.0f, x, kept)
#else
#define KEPT(x) (x)
#endif
    const words_t e = AS_WORDS(KEPT(v_both)) + HALF_LOST / 2;
    const words_t one = (AS_WORDS(KEPT(v_mean)) + HALF_LOST & ~LOST) | e >> 21;
    const words_t other = (AS_WORDS(KEPT(v_product)) + HALF_LOST & ~LOST) | (e >> 10 & LOST);
    STORE_PAIRS(one, other, out)
#ifdef ROBUST
    return fmax(similar, 1.0f - robust);
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
            sum += convert_long_rte((1.0f - lane[k]) * TILE_ONE);
    return sum;
}

__kernel TILE_LOOP
void ssim_forward(__global const stored_t *rendered, __global const uchar4 *photo, int width, int height, int pitch,
                  __global int *partials, float robust, float loss_scale, __global uint *total)
{
    __local float xs[CHANNELS * TALL * STRIDE] __attribute__((aligned(16)));
    __local shade_t ys[CHANNELS * TALL * STRIDE] __attribute__((aligned(16)));
    __local float sums[4 * TILE_H * STRIDE] __attribute__((aligned(16)));
#ifdef TRACK_LOSS
    __local long scratch[TILE_GROUP];
    long loss = 0;
#endif
    const int columns = width - HALO, rows = height - HALO, plane = pitch * height;
    const int left = span_start(get_group_id(0), TILE_W, columns), top = span_start(get_group_id(1), TILE_H, rows);
    load_tile(rendered, photo, left, top, width, height, xs, ys);
    barrier(CLK_LOCAL_MEM_FENCE);
    KEEP_LOOP for (int c = 0; c < CHANNELS; ++c) {
        blur_down(xs + c * TALL * STRIDE, ys + c * TALL * STRIDE, sums);
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int t = get_local_id(0); t < TILE_H * CHUNKS; t += TILE_GROUP) {
            const int y = t / CHUNKS, x = span_start(t % CHUNKS, LANES, TILE_W), row = top + y;
            if (row >= rows || left + x >= columns)
                continue;
            __local const float *at = sums + y * STRIDE + x;
            __global int *out = partials + 2 * (MARGIN + c * plane + row * pitch + left + x);
            const lanes_t similar = similarity(
                blur_across(at), blur_across(at + TILE_H * STRIDE), blur_across(at + 2 * TILE_H * STRIDE),
                blur_across(at + 3 * TILE_H * STRIDE), robust, out);
#ifdef TRACK_LOSS
            const int from = max((int)get_group_id(0) * TILE_W, left + t % CHUNKS * LANES);
            if (row >= (int)get_group_id(1) * TILE_H)
                loss += dissimilarity(similar, left + x, from, columns);
#endif
        }
        barrier(CLK_LOCAL_MEM_FENCE);
    }
#ifdef TRACK_LOSS
    add_losses(scratch, loss, loss_scale, total);
#endif
}
