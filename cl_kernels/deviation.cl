// How sure each depth is (method section 7).
#include "camera.clh"

#define SURROUNDINGS 2               // half the width of the surroundings of a pixel
#define MOST_BENT 1.4f    // pixels of parallax: as much as counts, at a discontinuity or where the surface ends

// Second difference of inverse depth at i, between i - stride and i + stride, in pixels of parallax.
float bend(__global const float *depth, int i, int stride, float u)
{
    const float d = depth[i], a = depth[i - stride], b = depth[i + stride];
    if (!(d > 0.0f && u > 0.0f))
        return 0.0f;
    return a > 0.0f && b > 0.0f ? fabs(second_difference(a, d, b)) * d * d / u : MOST_BENT;
}

// How much the surface bends at each pixel, along both directions.
__kernel void bends(__global const float *depth, __global const float *depth_per_parallax, int width, int height,
                    __global float *bent)                          // [H, W] pixels of parallax
{
    EACH_PIXEL(column, row, i, width, height)
    float sum = 0.0f;
    if (column > 0 && column + 1 < width)
        sum += bend(depth, i, 1, depth_per_parallax[i]);
    if (row > 0 && row + 1 < height)
        sum += bend(depth, i, width, depth_per_parallax[i]);
    bent[i] = fmin(sum, MOST_BENT);
}

// Standard deviation of each depth: what the sharpness of the match leaves, what the surface bends around it, which
// neither photos nor smoothness resolve, and what cameras that are off add. Infinite where nothing is known, as where
// photos refused a depth and do not show what the initial one says either (moving content: what matches does so by
// chance). The numbers are fitted to scenes with truth (tests/bench/calibration.py); larger ones enlarge deviations.
#define INFORMED 0.7f                // variance of a depth times the information of its match
#define BENT 0.35f                   // share of what the surface bends that a depth is wrong by
#define FINEST 0.02f                 // pixels of parallax: what no photo of this kind resolves
#define MISALIGNMENT 0.36f           // variance of a depth for a squared pixel of epipolar residual, divided by views

__kernel void deviate(__global const uchar *status, __global const float *depth_per_parallax, int width, int height,
                      __global const float *before, __global const float *after, __global const float *bent,
                      float error_factor, float misaligned, float mismatch, __global float *deviation)
{
    EACH_PIXEL(column, row, i, width, height)
    const float3 held = vload3(i, status[i] == REFINED ? after : before);
    const bool known = held.y > 0.0f && held.z > 0.0f && !(status[i] == REJECTED && held.x > mismatch * held.y);
    if (status[i] == NO_SURFACE || !known) {
        deviation[i] = status[i] == NO_SURFACE ? 0.0f : INFINITY;
        return;
    }
    float sum = 0.0f, number = 0.0f;
    EACH_AROUND(x, y, column, row, SURROUNDINGS, width, height) {
        sum += bent[y * width + x];
        number += 1.0f;
    }
    const float u = depth_per_parallax[i], bending = BENT * sum / number;
    const float match = INFORMED / held.z + u * u * (bending * bending + FINEST * FINEST);
    deviation[i] = sqrt(error_factor * error_factor * match + u * u * MISALIGNMENT * misaligned * misaligned / held.y);
}
