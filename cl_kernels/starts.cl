// Of two depth maps to start from, at each pixel that under which photos match better around it (method section 8.3).
//   list_places       every so many pixels along both sides, [rows, columns]
//   compare_starts    at which of these photos match better under the first one
//   take_better       the second one, but where most places around are such: the first one's depth
#include "constants.clh"

#define MOST_OF 4                        // of 9 places, more of which must match better for the first depth to stay

__kernel void list_places(int step, int width, int columns, int rows, __global int *places)
{
    EACH_PIXEL(x, y, k, columns, rows)
    places[k] = step * (y * width + x);
}

__kernel void compare_starts(__global const float *one, __global const float *other,
                             __global const float *one_cost, __global const float *other_cost,
                             int step, int width, int columns, int rows, __global uchar *better)
{
    EACH_PIXEL(x, y, k, columns, rows)
    const int i = step * (y * width + x);
    better[k] = one[i] != other[i] && one[i] > 0.0f && other[i] > 0.0f && one_cost[k] < other_cost[k];
}

__kernel void take_better(__global const float *one, __global const uchar *better, int step, int width, int height,
                          int columns, int rows, __global float *other)
{
    EACH_PIXEL(x, y, i, width, height)
    int around = 0;
    for (int row = max(y / step - 1, 0); row <= min(y / step + 1, rows - 1); ++row)
        for (int column = max(x / step - 1, 0); column <= min(x / step + 1, columns - 1); ++column)
            around += better[row * columns + column];
    if (around > MOST_OF && one[i] > 0.0f)
        other[i] = one[i];
}
