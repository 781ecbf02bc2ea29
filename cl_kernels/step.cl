// Adam and its schedule (method section 6).
#include "constants.clh"

// The schedule's state (RATE, BEST, WAITED, DONE, LOSS) lives on the device: the host never waits for a loss.

// Without branches, so that compilers for CPUs make vectors of it. first_scale and second_scale undo the bias of the
// first steps: 1 / (1 - beta1^number) and 1 / (1 - beta2^number).
__kernel void adam(__global float *restrict depth,                 // [H, W] units
                   __global float *gradient,                       // [H, W] of the photos, is cleared
                   __global const float *followed,                 // [H, W] N dL/dd, or `gradient` again
                   __global float *restrict first, __global float *restrict second,    // moments, [H, W]
                   __global const float *restrict depth_per_parallax,
                   __global const float *restrict state, int count, float first_scale, float second_scale,
                   float beta1, float beta2, float damping, float common_length, float share)
{
    EACH(i, count)
    const float d = depth[i], own = depth_per_parallax[i], rate = state[RATE] * share;
    const float u = own > 0.0f ? (common_length > 0.0f ? common_length : own) : 0.0f;
    const bool moving = d > 0.0f && state[DONE] == 0.0f;
    const float g = moving ? followed[i] * u : 0.0f;
    const float old_m = first[i], old_v = second[i];
    const float m = moving ? beta1 * old_m + (1.0f - beta1) * g : old_m;
    const float v = moving ? beta2 * old_v + (1.0f - beta2) * g * g : old_v;
    const float change = rate * u * m * first_scale / (sqrt(v * second_scale) + damping);
    gradient[i] = 0.0f;
    first[i] = m;
    second[i] = v;
    depth[i] = moving && v > 0.0f ? fmax(d - change, NEAR) : d;
}

// Add the smoothness, the sum of `count` partial sums.
__kernel void add_smoothness(__global const float *partials, int count, float scale, __global float *state)
{
    float sum = 0.0f;
    for (int k = 0; k < count; ++k)
        sum += partials[k];
    state[LOSS] += scale * sum;
}

// The photos' loss is a sum of its own, that of smoothness is in the state. The rate falls by 10 when the loss has not
// improved for `patience` steps; the level ends at `floor`.
__kernel void plateau(__global float *state, __global long *photo_loss,                // one number: L_c LOSS_ONE
                      __global float *history,                     // [steps] the loss of each
                      int number, int patience, float floor_rate)
{
    const float loss = (float)photo_loss[0] * (1.0f / LOSS_ONE) + state[LOSS];
    history[number - 1] = loss;
    photo_loss[0] = 0;
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
