// Gradient of the loss by each Gaussian's depth, order-free blend: a gather, since what a pixel passes back is the
// same affine function of colour for all that take part in it: dL/dalpha_i = G . c_i + h.
#include "splat.clh"

__kernel void gather_gradient(__global const float *depth, __global const uchar4 *target_photo,
                              __global const float *cameras, int view, float radius, float low_pass,
                              float threshold, float relative, __global const uint *z_first,
                              __global const float *exposure, __global const float *upstream,
                              __global float *gradient)
{
    const Camera target = load_camera(cameras, 0), context = load_camera(cameras, view);
    const int column = get_global_id(0), row = get_global_id(1);
    if (column >= target.width || row >= target.height)
        return;
    const int i = row * target.width + column;
    const float d = depth[i];
    Splat splat;
    Motion motion;
    if (!(d > 0.0f) || !project_gaussian(target, context, column, row, d, radius, low_pass, &splat, &motion))
        return;
    const Footprint f = footprint(splat.mean, radius, context.width, context.height);
    const color_t color = exposed_color(target_photo[i], exposure, view);
    float sum = 0.0f;
    for (int y = f.y0; y <= f.y1; y += 2)              // two by two, so that their loads overlap
        for (int x = f.x0; x <= f.x1; x += 2)
#pragma unroll
            for (int k = 0; k < 4; ++k) {
                const int u = min(x + k % 2, f.x1), v = min(y + k / 2, f.y1), pixel = v * context.width + u;
                const float2 delta = offset_from(splat, u, v);
                bool taken = dot(delta, delta) <= radius * radius && u == x + k % 2 && v == y + k / 2;
#ifdef OCCLUSION
                taken = taken && splat.z <= depth_limit(as_float(z_first[pixel]), threshold, relative);
#endif
                float v_weight;
                const color_t v_color = load_upstream(upstream, pixel, &v_weight);
                const float v_alpha = dot(v_color, color) + v_weight;
                sum += taken ? v_alpha * alpha_motion(splat, motion, delta, raw_alpha(splat, delta)) : 0.0f;
            }
    gradient[i] += sum;
}
