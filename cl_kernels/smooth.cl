// What holds a depth map together where photos say little (method section 5): per target pixel, added to the gradient.
#include "camera.clh"
#include "channels.clh"
#include "sums.clh"

// w_grad of one pixel.
float texture_weight(__global const uchar4 *photo, int x, int y, int width, int height)
{
    const int pixel = y * width + x, places[3] = {pixel, x + 1 < width ? pixel + 1 : pixel,
                                                  y + 1 < height ? pixel + width : pixel};
    float colors[3][CHANNELS];
    for (int k = 0; k < 3; ++k) {
        const color_t color = color_of(photo[places[k]]);
        for (int c = 0; c < CHANNELS; ++c)
            colors[k][c] = LANE(float, color, c);
    }
    return gradient_weight(colors[0], colors[1], colors[2], 1);
}

// kappa: pixels of parallax per unit of inverse depth; weights: less where the photo has texture
__kernel void smoothness_scale(__global const float *depth, __global const float *depth_per_parallax,
                               __global const uchar4 *photo, int width, int height, float texture,
                               __global float *kappa, __global float *weights)         // [H, W] both
{
    EACH_PIXEL(x, y, i, width, height)
    kappa[i] = depth_per_parallax[i] > 0.0f ? depth[i] * depth[i] / depth_per_parallax[i] : 0.0f;
    weights[i] = 1.0f - texture * texture_weight(photo, x, y, width, height);
}

// Raise the weight of each pixel by what `factors`, a grid over the image, say around it.
__kernel void raise_weights(__global const float *factors,         // [down, across]
                            int across, int down, int width, int height, __global float *weights)
{
    EACH_PIXEL(x, y, i, width, height)
    const float u = clamp((x + 0.5f) * across / width - 0.5f, 0.0f, across - 1.0f);
    const float v = clamp((y + 0.5f) * down / height - 0.5f, 0.0f, down - 1.0f);
    const int left = (int)u, top = (int)v, right = min(left + 1, across - 1), below = min(top + 1, down - 1);
    const float a = u - left, b = v - top;
    weights[i] *= BETWEEN(a, b, factors[top * across + left], factors[top * across + right],
                          factors[below * across + left], factors[below * across + right]);
}

// Integral of what fades, (1 - (t / discontinuity)^8)^2, from 0 to e.
float taper_integral(float e, float discontinuity)
{
    const float x = e / discontinuity, y = x * x * x * x, y2 = y * y;
    return e * (1.0f - y2 * (2.0f / 9.0f) + y2 * y2 * (1.0f / 17.0f));
}

float penalty(float e, float h, float discontinuity)
{
    const float size = fmin(fabs(e), discontinuity), inner = fmin(size, h);
    const float x = inner / discontinuity, y = x * x * x * x, y2 = y * y;
    const float quadratic = inner * inner / (2.0f * h) * (1.0f - 0.4f * y2 + y2 * y2 * (1.0f / 9.0f));
    return quadratic + taper_integral(size, discontinuity) - taper_integral(inner, discontinuity);
}

// Second difference of inverse depth w centred at i along `stride`, pixels of parallax; 0 where a neighbour is missing.
float bend(__global const float *depth, __global const float *kappa, int i, int stride, int along, int length)
{
    if (along < 1 || along >= length - 1)
        return 0.0f;
    const float d = depth[i], before = depth[i - stride], after = depth[i + stride];
    if (!(d > 0.0f && before > 0.0f && after > 0.0f))
        return 0.0f;
    return kappa[i] * second_difference(before, d, after);
}

float3 point_at(__global const float *depth, const Camera camera, int x, int y)
{
    return depth[y * camera.width + x] * pixel_ray(camera, x, y);
}

// n in xyz and 1 / |cross product| in w; w = 0 where a neighbour is missing
__kernel void normal_map(__global const float *depth, __constant float *cameras, __global float *normals)  // [H, W, 4]
{
    const Camera camera = load_camera(cameras, 0);
    const int width = camera.width, height = camera.height;
    EACH_PIXEL(x, y, i, width, height)
    float4 out = 0.0f;
    if (x > 0 && y > 0 && x < width - 1 && y < height - 1 && depth[i] > 0.0f && depth[i - 1] > 0.0f
        && depth[i + 1] > 0.0f && depth[i - width] > 0.0f && depth[i + width] > 0.0f) {
        const float3 a = point_at(depth, camera, x + 1, y) - point_at(depth, camera, x - 1, y);
        const float3 b = point_at(depth, camera, x, y + 1) - point_at(depth, camera, x, y - 1);
        const float3 c = cross(a, b);
        const float squared = dot(c, c);
        if (squared > 0.0f)
            out = (float4)(c * rsqrt(squared), rsqrt(squared));
    }
    vstore4(out, i, normals);
}

// slope by the cross product of pixel i: of its pairs with all four neighbours
__kernel void normal_slope(__global const float *normals, __global const float *weights, int width, int height,
                           float scale, __global float *slopes)    // [H, W, 3 and 0]
{
    EACH_PIXEL(x, y, i, width, height)
    const float4 n = vload4(i, normals);
    float3 v = 0.0f;
    if (n.w > 0.0f) {
        if (x + 1 < width)
            v -= weights[i] * vload4(i + 1, normals).xyz;
        if (y + 1 < height)
            v -= weights[i] * vload4(i + width, normals).xyz;
        if (x > 0)
            v -= weights[i - 1] * vload4(i - 1, normals).xyz;
        if (y > 0)
            v -= weights[i - width] * vload4(i - width, normals).xyz;
        v = 0.5f * scale * n.w * (v - n.xyz * dot(n.xyz, v));
    }
    vstore4((float4)(v, 0.0f), i, slopes);
}

// i is the right neighbour of i - 1, the left one of i + 1, the lower of i - width, the upper of i + width
__kernel void normal_vjp(__global const float *depth, __constant float *cameras, __global const float *slopes,
                         __global float *gradient)
{
    const Camera camera = load_camera(cameras, 0);
    const int width = camera.width, height = camera.height;
    EACH_PIXEL(x, y, i, width, height)
    float3 v = 0.0f;
    for (int side = -1; side <= 1; side += 2) {
        const int u = x - side, w = y - side;
        if (u > 0 && u < width - 1 && y > 0 && y < height - 1) {
            const float3 b = point_at(depth, camera, u, y + 1) - point_at(depth, camera, u, y - 1);
            v += side * cross(b, vload4(y * width + u, slopes).xyz);
        }
        if (w > 0 && w < height - 1 && x > 0 && x < width - 1) {
            const float3 a = point_at(depth, camera, x + 1, w) - point_at(depth, camera, x - 1, w);
            v += side * cross(vload4(w * width + x, slopes).xyz, a);
        }
    }
    if (depth[i] > 0.0f)
        gradient[i] += dot(v, pixel_ray(camera, x, y));
}

__kernel __attribute__((reqd_work_group_size(PENALTY_GROUP, 1, 1)))
void planar_loss(__global const float *depth, __global const float *kappa, __global const float *weights, int width,
                 int height, float h, float discontinuity, __global float *partials)   // [groups]
{
    __local float scratch[PENALTY_GROUP];
    float sum = 0.0f;
    for (int i = get_global_id(0); i < width * height; i += get_global_size(0)) {
        const float across = bend(depth, kappa, i, 1, i % width, width);
        const float down = bend(depth, kappa, i, width, i / width, height);
        sum += weights[i] * (penalty(across, h, discontinuity) + penalty(down, h, discontinuity));
    }
    leave_sum(sum, scratch, PENALTY_GROUP, partials);
}

// half of 1 - n . n' of each pixel and its neighbours to the right and below
__kernel __attribute__((reqd_work_group_size(PENALTY_GROUP, 1, 1)))
void normal_loss(__global const float *normals, __global const float *weights, int width, int height,
                 __global float *partials)                         // [groups]
{
    __local float scratch[PENALTY_GROUP];
    float sum = 0.0f;
    for (int i = get_global_id(0); i < width * height; i += get_global_size(0)) {
        const float4 n = vload4(i, normals);
        for (int side = 0; side < 2; ++side) {
            const int next = side ? i + width : i + 1;
            if (!(n.w > 0.0f) || (side ? next >= width * height : next % width == 0))
                continue;
            const float4 other = vload4(next, normals);
            if (other.w > 0.0f)
                sum += 0.5f * weights[i] * (1.0f - dot(n.xyz, other.xyz));
        }
    }
    leave_sum(sum, scratch, PENALTY_GROUP, partials);
}
