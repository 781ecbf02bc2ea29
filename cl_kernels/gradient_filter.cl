// The gradient averaged over neighbouring pixels before a step (method section 6): a tent of FILTER_RADIUS pixels to
// each side, in pixels of parallax, along one axis a launch. Neighbours that are off together push together; noise
// does not.
#include "constants.clh"

#define SHARE(k) ((FILTER_RADIUS + 1 - (k)) / (float)((FILTER_RADIUS + 1) * (FILTER_RADIUS + 1)))

__kernel void filter_across(__global const float *restrict gradient,                   // [H, W] by depth
                            __global const float *restrict depth_per_parallax, int width, int height,
                            __global float *restrict sums)                             // [H, W] by parallax
{
    EACH_PIXEL(x, y, i, width, height)
    float sum = SHARE(0) * gradient[i] * depth_per_parallax[i];
    UNROLL for (int k = 1; k <= FILTER_RADIUS; ++k) {
        const int left = x >= k ? i - k : i, right = x + k < width ? i + k : i;
        const float before = x >= k ? gradient[left] * depth_per_parallax[left] : 0.0f;
        const float after = x + k < width ? gradient[right] * depth_per_parallax[right] : 0.0f;
        sum += SHARE(k) * (before + after);
    }
    sums[i] = sum;
}

__kernel void filter_down(__global const float *restrict sums,                         // [H, W] by parallax
                          __global const float *restrict depth_per_parallax, int width, int height,
                          __global float *restrict gradient)                           // [H, W] by depth
{
    EACH_PIXEL(x, y, i, width, height)
    float sum = SHARE(0) * sums[i];
    UNROLL for (int k = 1; k <= FILTER_RADIUS; ++k) {
        const float before = y >= k ? sums[i - k * width] : 0.0f;
        const float after = y + k < height ? sums[i + k * width] : 0.0f;
        sum += SHARE(k) * (before + after);
    }
    gradient[i] = depth_per_parallax[i] > 0.0f ? sum / depth_per_parallax[i] : 0.0f;
}
