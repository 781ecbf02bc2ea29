// Pyramid levels (method section 6): photos and depth maps to another size.
#include "constants.clh"

// Share of pixel (u, v) of the source inside a box of it, at most 1.
float covered(int u, int v, float left, float right, float top, float bottom)
{
    const float across = fmin(right, u + 1.0f) - fmax(left, (float)u);
    return across * (fmin(bottom, v + 1.0f) - fmax(top, (float)v));
}

// Mean over the area of the source that a pixel covers; valid (w = 255) only where all of it is.
__kernel void shrink_photo(__global const uchar4 *source, int source_width, int source_height,
                           __global uchar4 *photo, int width, int height)
{
    EACH_PIXEL(x, y, i, width, height)
    const float sx = (float)source_width / width, sy = (float)source_height / height;
    const float left = x * sx, right = left + sx, top = y * sy, bottom = top + sy;
    float3 sum = 0.0f;
    float area = 0.0f;
    bool valid = true;
    for (int v = (int)top; v < min((int)ceil(bottom), source_height); ++v)
        for (int u = (int)left; u < min((int)ceil(right), source_width); ++u) {
            const float w = covered(u, v, left, right, top, bottom);
            const uchar4 p = source[v * source_width + u];
            if (!(w > 1e-6f))
                continue;
            sum += w * convert_float3(p.xyz);
            area += w;
            valid = valid && p.w != 0;
        }
    const float3 mean = sum / area;
    photo[y * width + x] = (uchar4)(convert_uchar3_sat_rte(mean), valid ? 255 : 0);
}

// Mean of the valid depths among the covered pixels.
__kernel void shrink_depth(__global const float *source, int source_width, int source_height, __global float *depth,
                           int width, int height)
{
    EACH_PIXEL(x, y, i, width, height)
    const float sx = (float)source_width / width, sy = (float)source_height / height;
    const float left = x * sx, right = left + sx, top = y * sy, bottom = top + sy;
    float sum = 0.0f, area = 0.0f;
    for (int v = (int)top; v < min((int)ceil(bottom), source_height); ++v)
        for (int u = (int)left; u < min((int)ceil(right), source_width); ++u) {
            const float w = covered(u, v, left, right, top, bottom);
            const float d = source[v * source_width + u];
            if (!(w > 1e-6f) || !(d > 0.0f))
                continue;
            sum += w * d;
            area += w;
        }
    depth[y * width + x] = area > 0.0f ? sum / area : 0.0f;
}

// Bilinear over the valid neighbours; validity and fallback come from `full`, the initial depth at this size.
__kernel void enlarge_depth(__global const float *source, int source_width, int source_height,
                            __global const float *full, __global float *depth, int width, int height)
{
    EACH_PIXEL(x, y, i, width, height)
    const float u = (x + 0.5f) * source_width / width - 0.5f, v = (y + 0.5f) * source_height / height - 0.5f;
    const int u0 = (int)floor(u), v0 = (int)floor(v);
    float sum = 0.0f, area = 0.0f;
    for (int dy = 0; dy <= 1; ++dy)
        for (int dx = 0; dx <= 1; ++dx) {
            const int a = clamp(u0 + dx, 0, source_width - 1), b = clamp(v0 + dy, 0, source_height - 1);
            const float w = (dx ? u - u0 : 1.0f - (u - u0)) * (dy ? v - v0 : 1.0f - (v - v0));
            const float d = source[b * source_width + a];
            sum += d > 0.0f ? w * d : 0.0f;
            area += d > 0.0f ? w : 0.0f;
        }
    depth[i] = full[i] > 0.0f ? (area > 1e-6f ? sum / area : full[i]) : 0.0f;
}
