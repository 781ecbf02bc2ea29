// Of two depth maps to start from, at each pixel that under which photos match better around it (method section 8.3).
//   list_places       every so many pixels along both sides, [rows, columns]
//   compare_starts    at which of these photos match better under the first one
//   take_better       the second one, but where most places around of the same surface are such: the first one's depth
#include "constants.clh"

#define SAME_SURFACE 0.5f                // of how far a depth moved, within which those around it are of its surface
#define LEAST_SAME 2                     // such places, most of which decide; of fewer all that are around do

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
    const float within = SAME_SURFACE * fabs(one[i] - other[i]);
    int number = 0, same = 0, better_of_number = 0, better_of_same = 0;
    EACH_AROUND(column, row, x / step, y / step, 1, columns, rows) {
        const int says = better[row * columns + column];
        const int counts = fabs(one[step * (row * width + column)] - one[i]) < within;
        ++number;
        better_of_number += says;
        same += counts;
        better_of_same += counts * says;
    }
    if ((same >= LEAST_SAME ? 2 * better_of_same > same : 2 * better_of_number > number) && one[i] > 0.0f)
        other[i] = one[i];
}
