// What rows of numbers have in common: how many there are, their mean, a quantile, the mean of their squares.
#include "constants.clh"

#define BINS 2048                        // of a row: resolution of its quantile

// One work-group a row; NaN is left out. rules: of each row the lowest and highest value that count for the quantile,
// and the share of the values below it. The quantile is good to a bin, within which it is interpolated.
__kernel __attribute__((reqd_work_group_size(SUMMARY_GROUP, 1, 1)))
void summarize(__global const float *rows, int count,              // [groups, count]
               __global const float4 *rules, __global float4 *summary)                 // [groups] both
{
    __local uint bins[BINS];
    __local float4 sums[SUMMARY_GROUP];
    const int row = get_group_id(0), lane = get_local_id(0);
    const float4 rule = rules[row];
    const float scale = BINS / (rule.y - rule.x);
    for (int b = lane; b < BINS; b += SUMMARY_GROUP)
        bins[b] = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    float4 sum = 0.0f;
    for (int k = lane; k < count; k += SUMMARY_GROUP) {
        const float value = rows[row * count + k];
        if (isnan(value))
            continue;
        sum += (float4)(1.0f, value, value * value, 0.0f);
        atomic_inc(&bins[(int)clamp((value - rule.x) * scale, 0.0f, BINS - 1.0f)]);
    }
    sums[lane] = sum;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (lane > 0)
        return;
    for (int k = 1; k < SUMMARY_GROUP; ++k)
        sum += sums[k];
    const float wanted = rule.z * sum.x;
    uint before = 0;
    int b = 0;
    while (b < BINS - 1 && (bins[b] == 0 || before + bins[b] < wanted))
        before += bins[b++];
    const float quantile = rule.x + (b + (wanted - before) / max(bins[b], 1u)) / scale;
    summary[row] = (float4)(sum.x, sum.x > 0.0f ? sum.y / sum.x : NAN, sum.x > 0.0f ? quantile : NAN,
                            sum.x > 0.0f ? sum.z / sum.x : NAN);
}
