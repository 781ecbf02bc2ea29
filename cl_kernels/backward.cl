// Gradient of the loss by each Gaussian's depth, order-free blend: a gather, since what a pixel passes back is the
// same affine function of colour for all that take part in it: dL/dalpha_i = G . c_i + h.
#include "splat.clh"
#include "exposed.clh"

// G . c + h of the pixels that are taken; whatever for the others.
#if ONE_PIXEL
// Loads do not wait for what decides whether they are needed: those of all pixels of a Gaussian are under way together.
float load_v_alpha(__global const float *v_rendered, int pixel, int taken, const float color[CHANNELS])
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
columns_t load_v_alpha(__global const float *v_rendered, mask_t pixels, mask_t taking, const columns_t color[CHANNELS])
{
    int pixel[COLUMNS], taken[COLUMNS];
    float up[CHANNELS + 1][COLUMNS];
    STORE_COLUMNS(pixels, pixel);
    STORE_COLUMNS(taking, taken);
    for (int k = 0; k < COLUMNS; ++k)
        for (int c = 0; c <= CHANNELS; ++c)
            up[c][k] = taken[k] ? v_rendered[pixel[k] * (CHANNELS + 1) + c] : 0.0f;
    columns_t sum = LOAD_COLUMNS(up[CHANNELS]);
    for (int c = 0; c < CHANNELS; ++c)
        sum += LOAD_COLUMNS(up[c]) * color[c];
    return sum;
}
#endif

// Add to the lanes from `first` on: those before belong to another work-item.
void add_columns(__global float *places, columns_t values, int first)
{
    if (first == 0) {
        STORE_COLUMNS(LOAD_COLUMNS(places) + values, places);
        return;
    }
    float lanes[COLUMNS];
    STORE_COLUMNS(values, lanes);
    for (int k = first; k < COLUMNS; ++k)
        places[k] += lanes[k];
}

__kernel void gather_gradient(__global const float *depth, __global const uchar4 *target_photo,
                              __constant float *cameras, int view, float low_pass, float threshold, float relative,
                              __global const uint *z_first, __global const float *exposure,
                              __global const float *v_rendered,    // [H', W', G and h]
                              __global float *gradient)            // [H, W] N dL/dd is added
{
    const Camera target = load_camera(cameras, 0), context = load_camera(cameras, view);
    int column;
    const int row = get_global_id(1);
    const Gaussians g = load_gaussians(depth, target, context, get_global_id(0), row, low_pass, &column);
    if (!ANY(g.own))
        return;
    const int i = row * target.width + column;
    columns_t color[CHANNELS], sum = ZERO;
    load_exposed(target_photo, i, exposure, view, color);
    const LogSlope slope = log_slope(g.splat, g.dsplat_ddepth);
    EACH_PLACE(u, v) {
        const Reach r = reach_pixel(&g, context, u, v);
        if (!ONE_PIXEL && !ANY(r.reached))
            continue;
        const columns_t share = share_of(&g, r, z_first, threshold, relative);
        const mask_t taken = share > 0.0f;
        const columns_t v_alpha = load_v_alpha(v_rendered, select((mask_t)(0), r.pixel, r.reached), taken, color);
        const columns_t raw = raw_alpha(g.splat, r.dx, r.dy);
        sum += select(ZERO, share * v_alpha * dalpha_ddepth(slope, g.dsplat_ddepth, r.dx, r.dy, raw), taken);
    }
    add_columns(gradient + i, sum, get_global_id(0) * COLUMNS - column);
}
