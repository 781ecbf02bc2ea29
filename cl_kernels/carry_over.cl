// What a smaller size has found, carried over to depths as they were given (method sections 6 and 8.3).
//   find_moves      by which share of its depth each pixel moved there, and how sure that is
//   follow_sure     their mean over the surroundings of the same surface, where it is far enough to count
//   carry_over      depths of another size moved along with those around them that were of the same surface
#include "constants.clh"

#define LEFT 0.5f                        // pixels of parallax at full size: a depth that moved by less is left to the
#define TAKEN 1.0f                       // steps there, one that moved by more is taken whole
#define AROUND 3                         // pixels to each side, over which it moves as those do that are sure
#define SUREST 0.1f                      // pixels of parallax: no depth counts for more than one of this deviation,
#define UNSURE 1e-3f                     // and one that photos do not confirm for so little, in 1 / squared pixels;
#define OWN 100.0f                       // times that a pixel itself counts: more leaves single depths astray, less
                                         // blurs what moves

__kernel void find_moves(__global const float *given, __global const float *depth, __global const float *parallax,
                         __global const float *deviation,          // or null: all are as sure
                         int count,
                         __global float *moves)                    // [h, w, 4] given, parallax, share, 1 / variance
{
    EACH(i, count)
    const float d = given[i], u = parallax[i], sure = fmax(deviation ? deviation[i] / u : 0.0f, SUREST);
    if (!(d > 0.0f && depth[i] > 0.0f && u > 0.0f)) {
        vstore4((float4)(0.0f), i, moves);
        return;
    }
    vstore4((float4)(d, u, (depth[i] - d) / d, fmax(1.0f / (sure * sure), UNSURE)), i, moves);
}

__kernel void follow_sure(__global const float *moves, int width, int height,
                          float scale,                             // of the full size; 0: however far, it counts
                          __global float *followed)                // [h, w, 3] given, parallax, share
{
    EACH_PIXEL(x, y, i, width, height)
    const float4 own = vload4(i, moves);
    float total = OWN * own.z * own.w, weight = OWN * own.w;
    EACH_AROUND(u, v, x, y, AROUND, width, height) {
        const float4 near = vload4(v * width + u, moves);
        const float counts = fabs(near.x - own.x) < own.y ? near.w : 0.0f;
        total += counts * near.z;
        weight += counts;
    }
    const float share = weight > 0.0f ? total / weight : 0.0f;
    float taken = 1.0f;
    if (scale > 0.0f && weight > 0.0f) {
        const float pixels = fabs(share) * own.x / (scale * own.y);
        taken = clamp((pixels - LEFT) / (TAKEN - LEFT), 0.0f, 1.0f);
    }
    vstore3((float3)(own.xy, share * taken), i, followed);
}

// depth[H, W] in place; followed[h, w, 3].
__kernel void carry_over(__global const float *followed, int small_width, int small_height,
                         __global float *depth, int width, int height)
{
    EACH_PIXEL(x, y, i, width, height)
    const float u = clamp((x + 0.5f) * small_width / width - 0.5f, 0.0f, small_width - 1.0f);
    const float v = clamp((y + 0.5f) * small_height / height - 0.5f, 0.0f, small_height - 1.0f);
    const int left = (int)u, top = (int)v;
    float total = 0.0f, weight = 0.0f;
    for (int k = 0; k < 4; ++k) {
        const int column = min(left + k % 2, small_width - 1), row = min(top + k / 2, small_height - 1);
        const float3 near = vload3(row * small_width + column, followed);
        const float part = fabs(near.x - depth[i]) < near.y
            ? (k % 2 ? u - left : 1.0f - (u - left)) * (k / 2 ? v - top : 1.0f - (v - top)) : 0.0f;
        total += part * near.z;
        weight += part;
    }
    if (weight > 0.0f)
        depth[i] *= 1.0f + total / weight;
}
