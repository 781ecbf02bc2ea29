// What draws a depth map to planes (method section 5): the slope of a penalty of second differences of inverse depth,
// in pixels of parallax.
#include "camera.clh"

// Slope of the penalty of the second difference e at d by inverse depth w of its ends, 0 where one is missing; twice
// that, negated, is the slope by its middle. The penalty is Huber's, up to h, and fades towards `discontinuity`.
columns_t v_bend(columns_t before, columns_t d, columns_t after, columns_t kappa, columns_t weight, float inverse_h,
                 float inverse_discontinuity)
{
    const columns_t e = kappa * second_difference(before, d, after), y = e * inverse_discontinuity;
    const columns_t t = y * y, slope = clamp(e * inverse_h, -1.0f, 1.0f) * fading(t < 1.0f ? t : 1.0f);
    return select(ZERO, weight * kappa * slope, (d > 0.0f) & (before > 0.0f) & (after > 0.0f));
}

__kernel void smoothness_planar(__global const float *depth, __global const float *kappa,
                                __global const float *weights, int width, int height, float scale, float h,
                                float discontinuity, __global float *gradient)         // [H, W] N dL/dd is added
{
    const int y = get_global_id(1);
    const float inverse_h = 1.0f / h, inverse_discontinuity = 1.0f / discontinuity;
    if (y >= height)
        return;
    EACH_VECTOR(item, width) {
        const int x = span_start(item, COLUMNS, width), i = y * width + x;
        const columns_t d = LOAD_COLUMNS(depth + i);
        columns_t v_inverse = ZERO;
        UNROLL for (int down = 0; down < 2; ++down) {
            columns_t line[5];
            UNROLL for (int k = 0; k < 5; ++k)
                line[k] = k == 2 ? d : load_around(depth, down ? x : x + k - 2, down ? y + k - 2 : y, width, height);
            UNROLL for (int k = -1; k <= 1; ++k) {
                const int u = down ? x : x + k, v = down ? y + k : y;
                const columns_t slope = v_bend(line[k + 1], line[k + 2], line[k + 3],
                                               load_around(kappa, u, v, width, height),
                                               load_around(weights, u, v, width, height), inverse_h,
                                               inverse_discontinuity);
                v_inverse += (k == 0 ? -2.0f : 1.0f) * slope;
            }
        }
        const columns_t change = select(ZERO, -scale * v_inverse / (d * d), d > 0.0f);
        add_columns(gradient + i, change, item * COLUMNS - x);
    }
}
