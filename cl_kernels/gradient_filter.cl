// The gradient that a step follows: that of the photos averaged over neighbouring pixels (method section 6), and what
// smoothness adds to it (section 5). The average is a tent of FILTER_RADIUS pixels to each side, in pixels of parallax,
// along columns, then rows. Neighbours that are off together push together; noise does not.
#include "camera.clh"

// Slope of the penalty of the second difference e at d by inverse depth w of its ends, 0 where one is missing; twice
// that, negated, is the slope by its middle. The penalty is Huber's, up to h, and fades towards `discontinuity`.
columns_t v_bend(columns_t before, columns_t d, columns_t after, columns_t kappa, columns_t weight, float inverse_h,
                 float inverse_discontinuity)
{
    const columns_t e = kappa * second_difference(before, d, after), y = e * inverse_discontinuity;
    const columns_t t = y * y, slope = clamp(e * inverse_h, -1.0f, 1.0f) * taper(t < 1.0f ? t : 1.0f);
    return select(ZERO, weight * kappa * slope, (d > 0.0f) & (before > 0.0f) & (after > 0.0f));
}

// Of a tile at (left, top) and one pixel around it: slopes of the bends along rows and along columns.
#define BENT_W (TILE_W + 2)
#define BENT (BENT_W * (TILE_H + 2))
#define BENT_ACROSS ((BENT_W + COLUMNS - 1) / COLUMNS)

void find_bends(__global const float *depth, __global const float *kappa, __global const float *weights, int left,
                int top, int width, int height, float h, float discontinuity, __local float bends[2 * BENT])
{
    const float inverse_h = 1.0f / h, inverse_discontinuity = 1.0f / discontinuity;
    for (int t = get_local_id(0); t < (TILE_H + 2) * BENT_ACROSS; t += TILE_GROUP) {
        const int column = span_start(t % BENT_ACROSS, COLUMNS, BENT_W), row = t / BENT_ACROSS;
        const int x = left + column - 1, y = top + row - 1;
        const columns_t d = load_around(depth, x, y, width, height), k = load_around(kappa, x, y, width, height);
        const columns_t w = load_around(weights, x, y, width, height);
        UNROLL for (int down = 0; down < 2; ++down) {
            const columns_t before = load_around(depth, x - !down, y - down, width, height);
            const columns_t after = load_around(depth, x + !down, y + down, width, height);
            STORE_COLUMNS(v_bend(before, d, after, k, w, inverse_h, inverse_discontinuity),
                          bends + down * BENT + row * BENT_W + column);
        }
    }
}

// Slope by inverse depth at a place of the tile: each bend pulls its two ends one way, and its middle twice the other.
columns_t planar_slope(__local const float bends[2 * BENT], int column, int row)
{
    columns_t slope = ZERO;
    UNROLL for (int down = 0; down < 2; ++down)
        UNROLL for (int k = -1; k <= 1; ++k)
            slope += (k == 0 ? -2.0f : 1.0f) * LOAD_COLUMNS(
                bends + down * BENT + (row + 1 + (down ? k : 0)) * BENT_W + column + 1 + (down ? 0 : k));
    return slope;
}

#ifdef FILTER_RADIUS
#define SHARE(k) ((FILTER_RADIUS + 1 - (k)) / (float)((FILTER_RADIUS + 1) * (FILTER_RADIUS + 1)))
#define PULL_W (TILE_W + 2 * FILTER_RADIUS)    // columns of which a tile's averages along rows are made
#define PULL_ACROSS ((PULL_W + COLUMNS - 1) / COLUMNS)

// Averages along columns, of RUN rows at a time: what is read serves all of them.
void filter_down(__global const float *gradient, __global const float *depth_per_parallax, int left, int top,
                 int width, int height, __local float columns[TILE_H * PULL_W])
{
    for (int t = get_local_id(0); t < TILE_H / RUN * PULL_ACROSS; t += TILE_GROUP) {
        const int column = span_start(t % PULL_ACROSS, COLUMNS, PULL_W), row = t / PULL_ACROSS * RUN;
        columns_t sum[RUN];
        UNROLL for (int k = 0; k < RUN; ++k)
            sum[k] = ZERO;
        UNROLL for (int j = -FILTER_RADIUS; j < RUN + FILTER_RADIUS; ++j) {
            const int x = left + column - FILTER_RADIUS, y = top + row + j;
            const columns_t pull = load_around(gradient, x, y, width, height)
                                   * load_around(depth_per_parallax, x, y, width, height);
            UNROLL for (int k = 0; k < RUN; ++k)
                if (abs(j - k) <= FILTER_RADIUS)
                    sum[k] += SHARE(abs(j - k)) * pull;
        }
        UNROLL for (int k = 0; k < RUN; ++k)
            STORE_COLUMNS(sum[k], columns + (row + k) * PULL_W + column);
    }
}

columns_t filter_across(__local const float *middle)
{
    columns_t sum = SHARE(0) * LOAD_COLUMNS(middle);
    UNROLL for (int k = 1; k <= FILTER_RADIUS; ++k)
        sum += SHARE(k) * (LOAD_COLUMNS(middle - k) + LOAD_COLUMNS(middle + k));
    return sum;
}
#endif

__kernel TILE_LOOP
void filter_gradient(__global const float *gradient, __global const float *depth_per_parallax,
                     __global const float *depth, __global const float *kappa, __global const float *weights, int width,
                     int height, float scale, float h, float discontinuity, __global float *followed)
{
    const int left = get_group_id(0) * TILE_W, top = get_group_id(1) * TILE_H;
#ifdef FILTER_RADIUS
    __local float columns[TILE_H * PULL_W];
    filter_down(gradient, depth_per_parallax, left, top, width, height, columns);
#endif
#ifdef PLANAR
    __local float bends[2 * BENT];
    find_bends(depth, kappa, weights, left, top, width, height, h, discontinuity, bends);
#endif
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int t = get_local_id(0); t < TILE_H * TILE_ACROSS; t += TILE_GROUP) {
        const int row = t / TILE_ACROSS, column = t % TILE_ACROSS * COLUMNS, x = left + column, y = top + row;
        if (x >= width || y >= height)
            continue;
#ifdef FILTER_RADIUS
        const columns_t length = load_around(depth_per_parallax, x, y, width, height);
        columns_t sum = filter_across(columns + row * PULL_W + column + FILTER_RADIUS);
        sum = select(ZERO, sum / length, length > 0.0f);
#else
        columns_t sum = load_around(gradient, x, y, width, height);
#endif
#ifdef PLANAR
        const columns_t d = load_around(depth, x, y, width, height);
        sum += select(ZERO, -scale * planar_slope(bends, column, row) / (d * d), d > 0.0f);
#endif
        put_columns(followed + y * width + x, sum, width - x);
    }
}
