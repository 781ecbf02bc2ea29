// Adam and its schedule (method section 6).
#include "constants.clh"

// The schedule's state lives on the device, so that the host never waits for a loss.
#define RATE 0
#define BEST 1
#define WAITED 2
#define DONE 3
#define LOSS 4

// Without branches, so that compilers for CPUs make vectors of it. first_scale and second_scale undo the bias of the
// first steps: 1 / (1 - beta1^pass) and 1 / (1 - beta2^pass).
__kernel void adam(__global float *restrict depth, __global float *restrict gradient, __global float *restrict first,
                   __global float *restrict second, __global const float *restrict unit,
                   __global const float *restrict state, int count, float first_scale, float second_scale,
                   float beta1, float beta2, float damping, float common_unit, float share)
{
    const int i = get_global_id(0);
    if (i >= count)
        return;
    const float d = depth[i], own = unit[i], rate = state[RATE] * share;
    const float u = own > 0.0f ? (common_unit > 0.0f ? common_unit : own) : 0.0f;
    const bool moving = d > 0.0f && state[DONE] == 0.0f;
    const float g = moving ? gradient[i] * u : 0.0f;
    const float old_m = first[i], old_v = second[i];
    const float m = moving ? beta1 * old_m + (1.0f - beta1) * g : old_m;
    const float v = moving ? beta2 * old_v + (1.0f - beta2) * g * g : old_v;
    const float change = rate * u * m * first_scale / (sqrt(v * second_scale) + damping);
    gradient[i] = 0.0f;
    first[i] = m;
    second[i] = v;
    depth[i] = moving && v > 0.0f ? fmax(d - change, NEAR) : d;
}

#define ADD_GROUP 256                    // as in splat/loss.py

// Sum of partial losses over the work-group, for its first work-item.
long sum_partials(__global const long *partials, int count, __local long *scratch)
{
    const int lane = get_local_id(0);
    long sum = 0;
    for (int k = lane; k < count; k += ADD_GROUP)
        sum += partials[k];
    for (int apart = ADD_GROUP / 2; apart > 0; apart /= 2) {
        scratch[lane] = sum;
        barrier(CLK_LOCAL_MEM_FENCE);
        if (lane < apart)
            sum += scratch[lane + apart];
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    return sum;
}

// Add the loss of one view, SSIM and L1; in whole numbers, so that the order does not matter.
__kernel __attribute__((reqd_work_group_size(ADD_GROUP, 1, 1)))
void add_loss(__global const long *ssim, int ssim_count, float ssim_scale, __global const long *l1, int l1_count,
              float l1_scale, __global float *state)
{
    __local long scratch[ADD_GROUP];
    const long ssim_sum = sum_partials(ssim, ssim_count, scratch), l1_sum = sum_partials(l1, l1_count, scratch);
    if (get_local_id(0) == 0)
        state[LOSS] += ((float)ssim_sum * ssim_scale + (float)l1_sum * l1_scale) * (1.0f / 4294967296.0f);
}

// Add the smoothness, the sum of `count` partial sums.
__kernel void add_smoothness(__global const float *partials, int count, float scale, __global float *state)
{
    float sum = 0.0f;
    for (int k = 0; k < count; ++k)
        sum += partials[k];
    state[LOSS] += scale * sum;
}

// The rate falls by 10 when the loss has not improved for `patience` steps; the level ends at `floor`.
__kernel void plateau(__global float *state, __global float *history, int pass, int patience, float floor_rate)
{
    const float loss = state[LOSS];
    history[pass - 1] = loss;
    state[LOSS] = 0.0f;
    if (loss < state[BEST]) {
        state[BEST] = loss;
        state[WAITED] = 0.0f;
    } else
        state[WAITED] += 1.0f;
    if (state[WAITED] >= patience) {
        state[WAITED] = 0.0f;
        state[RATE] *= 0.1f;
        if (state[RATE] < floor_rate)
            state[DONE] = 1.0f;
    }
}
