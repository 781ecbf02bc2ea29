// Gradient of the loss by each Gaussian's depth, order-free blend: a gather, since what a pixel passes back is the
// same affine function of colour for all that take part in it: dL/dalpha_i = G . c_i + h.
#include "weights.clh"
#include "exposed.clh"

#if ONE_PIXEL
// G . c + h. Loads do not wait for what decides whether they are needed: those of all pixels of a Gaussian are under
// way together.
float load_v_alpha(__global const float *v_rendered, int pixel, const float color[CHANNELS])
{
#ifdef GREY
    LOAD_TWO(float, v_rendered + 2 * pixel, g, h)
    return g * color[0] + h;
#else
    LOAD_FOUR(float, v_rendered + 4 * pixel, red, green, blue, h)
    return red * color[0] + green * color[1] + blue * color[2] + h;
#endif
}
#else
// Of each Gaussian: what its pixels pass back, times the `slopes` of its weight in them, summed; then G . c + h.
columns_t sum_v_alpha(__global const float *v_rendered, const mask_t pixels[PLACES], const columns_t slopes[PLACES],
                      const columns_t color[CHANNELS])
{
    float passed[(CHANNELS + 1) * COLUMNS];
    for (int k = 0; k < COLUMNS; ++k) {
        PAINT(float) sum = 0.0f;
        UNROLL_SPAN for (int place = 0; place < PLACES; ++place)
            sum += LANE(float, slopes[place], k) * PAINT(vload)(LANE(int, pixels[place], k), v_rendered);
        PAINT(vstore)(sum, k, passed);
    }
#ifdef GREY
    LOAD_TWO(float, passed, g, h)
    return g * color[0] + h;
#else
    LOAD_FOUR(float, passed, red, green, blue, h)
    return red * color[0] + green * color[1] + blue * color[2] + h;
#endif
}
#endif

__kernel void gather_gradient(__global const float *depth, __global const uchar4 *target_photo,
                              __constant float *cameras, int view, float radius_threshold, float inverse_area,
                              float low_pass, float depth_threshold, float depth_relative, __global const uint *z_first,
                              __global const float *exposure, __global const float *v_rendered,
                              __global float *gradient)
{
    const Camera target = load_camera(cameras, 0), context = load_camera(cameras, view);
    const int row = get_global_id(1);
    EACH_VECTOR(item, target.width) {
        int column;
        const Gaussians g = load_gaussians(depth, target, context, item, row, radius_threshold, low_pass, &column);
        if (!ANY(g.own))
            continue;
        const int i = row * target.width + column;
        columns_t color[CHANNELS], sum = ZERO;
        load_exposed(target_photo, i, exposure, view, color);
        const LogSlope slope = log_slope(g.splat, g.dsplat_ddepth);
#if !ONE_PIXEL
        mask_t pixels[PLACES];
        columns_t slopes[PLACES];
#endif
        EACH_PLACE(u, v) {
            const Reach r = reach_pixel(&g, context.width, 0, context.height, u, v);
            const columns_t share = share_of(&g, r, z_first, depth_threshold, depth_relative);
            const mask_t taken = share > 0.0f;
            const columns_t raw = raw_alpha(g.splat, r.dx, r.dy);
            const columns_t dalpha = dalpha_ddepth(slope, g.dsplat_ddepth, r.dx, r.dy, raw, inverse_area);
#if ONE_PIXEL
            sum += taken ? share * load_v_alpha(v_rendered, r.reached ? r.pixel : 0, color) * dalpha : 0.0f;
#else
            slopes[v * SPAN + u] = select(ZERO, share * dalpha, taken);
            pixels[v * SPAN + u] = r.pixel;
#endif
        }
#if !ONE_PIXEL
        sum = sum_v_alpha(v_rendered, pixels, slopes, color);
#endif
        add_columns(gradient + i, sum, item * COLUMNS - column);
    }
}
