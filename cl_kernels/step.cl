// Adam and its schedule (method section 6).
#include "constants.clh"

// The schedule's state lives on the device, so that the host never waits for a loss.
#define RATE 0
#define BEST 1
#define WAITED 2
#define DONE 3
#define LOSS 4

__kernel void adam(__global float *depth, __global float *gradient, __global float *first, __global float *second,
                   __global const float *unit, __global const float *state, int count, int pass, float damping,
                   float common_unit, float share)
{
    const int i = get_global_id(0);
    if (i >= count)
        return;
    const float d = depth[i];
    const float u = unit[i] > 0.0f ? (common_unit > 0.0f ? common_unit : unit[i]) : 0.0f;
    const float g = gradient[i] * u;
    gradient[i] = 0.0f;
    if (!(d > 0.0f) || state[DONE] != 0.0f)
        return;
    const float m = 0.9f * first[i] + 0.1f * g;
    const float v = 0.999f * second[i] + 0.001f * g * g;
    first[i] = m;
    second[i] = v;
    const float m_hat = m / (1.0f - pown(0.9f, pass)), v_hat = v / (1.0f - pown(0.999f, pass));
    const float change = v > 0.0f ? state[RATE] * share * u * m_hat / (sqrt(v_hat) + damping) : 0.0f;
    depth[i] = fmax(d - change, NEAR);
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
