// What photos are aligned by (method section 9): luminance in grey levels, smoothed, minus its mean over a window,
// divided by its standard deviation there. Gain, offset and shading drop out.
#include "photo.clh"

__kernel void luminance(__global const uchar4 *photo, int width, int height, __global float2 *pair)
{
    EACH_PIXEL(x, y, i, width, height)
    const float valid = photo[i].w != 0 ? 1.0f : 0.0f;
    pair[i] = (float2)(valid * 255.0f * grey_of(photo[i]), valid);
}

// `taps`: radius + 1 of them, the middle one first.
float2 averaged(__global const float2 *pair, int at, int stride, int place, int count, __global const float *taps,
                int radius)
{
    float2 sum = taps[0] * pair[at];
    for (int k = 1; k <= radius; ++k)
        sum += taps[k] * ((place >= k ? pair[at - k * stride] : 0.0f)
                          + (place + k < count ? pair[at + k * stride] : 0.0f));
    return sum;
}

__kernel void smooth_rows(__global const float2 *pair, int width, int height, __global const float *taps, int radius,
                          __global float2 *out)
{
    EACH_PIXEL(x, y, i, width, height)
    out[i] = averaged(pair, i, 1, x, width, taps, radius);
}

__kernel void smooth_columns(__global const float2 *pair, int width, int height, __global const float *taps,
                             int radius, __global float2 *out)
{
    EACH_PIXEL(x, y, i, width, height)
    out[i] = averaged(pair, i, width, y, height, taps, radius);
}

__kernel void normalize_photo(__global const float2 *pair, __global const uchar4 *photo, int width, int height,
                              __global float *normal)         // not a number where the photo is masked out
{
    EACH_PIXEL(x, y, i, width, height)
    const float here = pair[i].x / pair[i].y;
    float number = 0.0f, sum = 0.0f, squares = 0.0f;          // of differences from the middle: they keep their digits
    EACH_AROUND(u, v, x, y, WINDOW, width, height) {
        const int at = v * width + u;
        const float2 p = pair[at];
        const float inside = photo[at].w != 0 ? 1.0f : 0.0f, off = p.y > 0.0f ? inside * (p.x / p.y - here) : 0.0f;
        number += inside;
        sum += off;
        squares += off * off;
    }
    const float mean = sum / number;
    const float deviation = sqrt(fmax(squares / number - mean * mean, 0.0f));
    normal[i] = photo[i].w != 0 ? -mean / (deviation + SOFTENING) : NAN;
}
