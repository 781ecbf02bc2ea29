// Gain and offset of each channel from the target's photo to each context photo, in closed form (method section 7).
// One match is 8 floats: colour of the target, state, colour of the context photo, 0. State: 0 not seen, 1 seen,
// 2 seen and nowhere near black or saturated.
#include "lookup.clh"
#include "sums.clh"

#define HALF 2                           // half the width of a patch
#define RIM (HALF + 1)
#define PATCH_PIXELS ((2 * HALF + 1) * (2 * HALF + 1))
#define DARKEST (4.0f / 255.0f)          // beyond these a channel may be clipped and says nothing of the gain
#define BRIGHTEST (251.0f / 255.0f)

// Looking up between pixels blurs as the kernel (1, 10, 1) / 12 does on average. The target is blurred alike, or its
// larger contrast would pass for a lower gain: weights of a patch with its rim.
__constant float BLURRED[2 * RIM + 1] = {1.0f / 12, 11.0f / 12, 1, 1, 1, 11.0f / 12, 1.0f / 12};

bool unclipped(float3 c)
{
    return all(c > DARKEST) && all(c < BRIGHTEST);
}

__kernel void match_colors(__global const float *depth, __constant float *cameras, int view, float depth_threshold,
                           __global const uint *z_first, __global const uchar4 *target_photo,
                           __global const uchar4 *photo, int stride, int across, int count, __global float *matches)
{
    const Camera target = load_camera(cameras, 0), context = load_camera(cameras, view);
    EACH(k, count)
    __global float *match = matches + 8 * ((view - 1) * count + k);
    vstore8(0.0f, 0, match);
    const int2 at = sample_place(k, stride, across, target);
    if (at.x < RIM || at.y < RIM || at.x >= target.width - RIM || at.y >= target.height - RIM)
        return;
    float3 own = 0.0f, other = 0.0f;
    bool usable = true;
    for (int v = -RIM; v <= RIM; ++v)
        for (int u = -RIM; u <= RIM; ++u) {
            const int i = (at.y + v) * target.width + at.x + u;
            const float3 here = rgb_of(target_photo[i]);
            const float d = depth[i];
            own += BLURRED[v + RIM] * BLURRED[u + RIM] * here;
            if (!(d > 0.0f))
                return;
            if (max(abs(u), abs(v)) == RIM)
                continue;
            const float3 m = project_mean(target, context, at.x + u, at.y + v, d);
            float3 there;
            if (!(m.z > NEAR) || !look_up(photo, context, m.xy, &there))
                return;
#ifdef OCCLUSION
            if (m.z > as_float(z_first[(int)m.y * context.width + (int)m.x]) + depth_threshold)
                return;
#endif
            usable = usable && unclipped(here) && unclipped(there);
            other += there;
        }
    vstore4((float4)(own * (1.0f / PATCH_PIXELS), usable ? 2.0f : 1.0f), 0, match);
    vstore4((float4)(other * (1.0f / PATCH_PIXELS), 0.0f), 1, match);
}

#define ROUNDS 6                         // of reweighting by the residuals
#define LEAST 50                         // samples for a fit
#define PRIOR 2e-5f                      // variance of colour below which the gain is drawn to the ratio of means
#define BINS 1024                        // of residuals, for their median
#define LARGEST 0.25f                    // residual, 0 to 1, at the end of the bins

float residual_of(__global const float *match, int channel, float gain, float offset)
{
    return fabs(match[4 + channel] - gain * match[channel] - offset);
}

// 1 up to `scale`, then less, so that what does not match counts no more than what does; 0 for what says nothing.
float weight_of(__global const float *match, int channel, float gain, float offset, float scale)
{
    if (match[3] < 2.0f)
        return 0.0f;
    const float weight = fmin(1.0f, scale / fmax(residual_of(match, channel, gain, offset), 1e-12f));
    return weight * weight;
}

// Median of the residuals of the usable matches, in bins.
float median_residual(__global const float *matches, int count, int channel, float gain, float offset, float usable,
                      __local uint *bins, __local float *median)
{
    const int lane = get_local_id(0);
    for (int b = lane; b < BINS; b += FIT_GROUP)
        bins[b] = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int k = lane; k < count; k += FIT_GROUP)
        if (matches[8 * k + 3] >= 2.0f) {
            const float r = residual_of(matches + 8 * k, channel, gain, offset) * (BINS / LARGEST);
            atomic_inc(&bins[(int)fmin(r, BINS - 1.0f)]);
        }
    barrier(CLK_LOCAL_MEM_FENCE);
    if (lane == 0) {
        uint before = 0;
        int b = 0;
        while (b < BINS - 1 && before + bins[b] < 0.5f * usable)
            before += bins[b++];
        *median = (b + (0.5f * usable - before) / max(bins[b], 1u)) * (LARGEST / BINS);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    const float found = *median;
    barrier(CLK_LOCAL_MEM_FENCE);
    return found;
}

// One work-group a channel of a context view: (channel, view - 1). The gain is the ratio of the deviations, so that
// neither photo's noise nor a depth error draws it to zero, as it would in a least squares fit.
__kernel __attribute__((reqd_work_group_size(FIT_GROUP, 1, 1)))
void fit_exposure(__global const float *all_matches, int count, __global float *exposure)
{
    __local float scratch[FIT_GROUP], median;
    __local uint bins[BINS];
    const int channel = get_group_id(0), view = get_group_id(1) + 1, lane = get_local_id(0);
    __global const float *matches = all_matches + 8 * (view - 1) * count;
    float gain = 1.0f, offset = 0.0f, scale = INFINITY, usable = 0.0f;
    for (int k = lane; k < count; k += FIT_GROUP)
        usable += matches[8 * k + 3] >= 2.0f ? 1.0f : 0.0f;
    usable = sum_of_group(usable, scratch, FIT_GROUP);
    for (int round = 0; round < ROUNDS && usable >= LEAST; ++round) {
        float w = 0.0f, x = 0.0f, y = 0.0f, xx = 0.0f, yy = 0.0f;
        for (int k = lane; k < count; k += FIT_GROUP) {
            const float weight = weight_of(matches + 8 * k, channel, gain, offset, scale);
            w += weight;
            x += weight * matches[8 * k + channel];
            y += weight * matches[8 * k + 4 + channel];
        }
        const float total = sum_of_group(w, scratch, FIT_GROUP);
        const float mx = sum_of_group(x, scratch, FIT_GROUP) / total, my = sum_of_group(y, scratch, FIT_GROUP) / total;
        for (int k = lane; k < count; k += FIT_GROUP) {
            const float weight = weight_of(matches + 8 * k, channel, gain, offset, scale);
            const float dx = matches[8 * k + channel] - mx, dy = matches[8 * k + 4 + channel] - my;
            xx += weight * dx * dx;
            yy += weight * dy * dy;
        }
        const float var_x = sum_of_group(xx, scratch, FIT_GROUP) / total;
        const float var_y = sum_of_group(yy, scratch, FIT_GROUP) / total;
        const float ratio = my / mx;
        gain = sqrt((var_y + PRIOR * ratio * ratio) / (var_x + PRIOR));
        offset = my - gain * mx;
        scale = 1.5f * 1.4826f * median_residual(matches, count, channel, gain, offset, usable, bins,
                                                 &median) + 1e-4f;
    }
    const bool sane = usable >= LEAST && gain > 0.05f && gain < 20.0f;
    if (lane == 0) {
        exposure[6 * view + channel] = sane ? gain : 1.0f;
        exposure[6 * view + 3 + channel] = sane ? offset : 0.0f;
    }
}
