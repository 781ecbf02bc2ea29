// The gradient that a step follows: that of the photos averaged over neighbouring pixels (method section 6), and what
// smoothness adds to it (section 5). The average is a tent of FILTER_RADIUS pixels to each side, in pixels of parallax,
// along rows, then columns. Neighbours that are off together push together; noise does not.
#include "planar.clh"

#ifdef FILTER_RADIUS
#define SHARE(k) ((FILTER_RADIUS + 1 - (k)) / (float)((FILTER_RADIUS + 1) * (FILTER_RADIUS + 1)))
#define ROWS (TILE_H + 2 * FILTER_RADIUS)      // of which a tile's averages along columns are made

columns_t by_parallax(__global const float *gradient, __global const float *depth_per_parallax, int x, int y, int width,
                      int height)
{
    return load_around(gradient, x, y, width, height) * load_around(depth_per_parallax, x, y, width, height);
}

void filter_across(__global const float *gradient, __global const float *depth_per_parallax, int left, int top,
                   int width, int height, __local float rows[ROWS * TILE_W])
{
    for (int t = get_local_id(0); t < ROWS * TILE_ACROSS; t += TILE_GROUP) {
        const int x = left + t % TILE_ACROSS * COLUMNS, y = top + t / TILE_ACROSS - FILTER_RADIUS;
        columns_t sum = SHARE(0) * load_around(gradient, x, y, width, height)
                        * load_around(depth_per_parallax, x, y, width, height);
        UNROLL for (int k = 1; k <= FILTER_RADIUS; ++k)
            sum += SHARE(k) * (by_parallax(gradient, depth_per_parallax, x - k, y, width, height)
                               + by_parallax(gradient, depth_per_parallax, x + k, y, width, height));
        STORE_COLUMNS(sum, rows + t * COLUMNS);
    }
}

columns_t filter_down(__local const float *middle)
{
    columns_t sum = SHARE(0) * LOAD_COLUMNS(middle);
    UNROLL for (int k = 1; k <= FILTER_RADIUS; ++k)
        sum += SHARE(k) * (LOAD_COLUMNS(middle - k * TILE_W) + LOAD_COLUMNS(middle + k * TILE_W));
    return sum;
}
#endif

__kernel TILE_LOOP
void filter_gradient(__global const float *gradient,               // of the photos
                     __global const float *depth_per_parallax,
                     __global const float *depth, __global const float *kappa, __global const float *weights,
                     int width, int height, float scale, float h, float discontinuity,
                     __global float *followed)                     // [H, W] N dL/dd
{
    const int left = get_group_id(0) * TILE_W, top = get_group_id(1) * TILE_H;
#ifdef FILTER_RADIUS
    __local float rows[ROWS * TILE_W];
    filter_across(gradient, depth_per_parallax, left, top, width, height, rows);
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
        columns_t sum = filter_down(rows + (row + FILTER_RADIUS) * TILE_W + column);
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
