// The evidence for each effect, measured on a grid of samples under the initial depth (method section 8).
// Values of a context view are ROWS rows of one number a sample, NaN where there is none; summary.cl sums them up.
// In this order (numbered by splat/measure.py):
//   HIDDEN            1 hidden behind a nearer surface, 0 seen
//   SIZE              standard deviation of the projected Gaussian, pixels
//   CHANGE            colour of the context photo less the target's, three channels
//   EPIPOLAR_OFFSET   epipolar residual: pixels between photo and match across the direction of depth,
//                     by the target's quadrant
//   SPECULARITY       what the exposure fit leaves, averaged over neighbouring samples
//   LIKE              0 where the photos show other things there, or show that the depth is wrong; else 1
//   EXPLAINED         share of a patch's variance that the photo explains
//   PARALLAX          squared pixels by which it moves where the depth grows by its own size
#include "gaussian.clh"
#include "lookup.clh"

#define TOTALS (SHIFTS + 2)      // of a sample: views that see it, those of them with texture, their costs by shift

#define HALF 2                   // half the width of a patch
#define LEAST_PIXELS 15          // of a patch must be inside the photo
#define MOVES (SHIFTS + OFFSETS)
#ifndef SIDE_BY_SIDE
#define SIDE_BY_SIDE 1           // moves of a patch that a work-item handles: one, or a native vector on a CPU
#endif
#if SIDE_BY_SIDE == 1
typedef float moves_t;
typedef int whole_t;
#define TO_MOVES(v) convert_float(v)
#define WHOLE(v) convert_int(v)
#else
typedef JOIN(float, SIDE_BY_SIDE) moves_t;
typedef JOIN(int, SIDE_BY_SIDE) whole_t;
#define TO_MOVES(v) JOIN(convert_float, SIDE_BY_SIDE)(v)
#define WHOLE(v) JOIN(convert_int, SIDE_BY_SIDE)(v)
#endif
#define UNDEFINED 2.0f           // cost of a patch without texture or outside the photo: the largest there is
#define TEXTURED 1.5f            // costs above this are of patches without texture: nothing is read from them
#define WORSE 0.02f              // a depth that matches worse than another by more is not the right one
#define OTHER 0.5f               // costs above this are of patches that show something else

// Pixels of parallax along the direction of depth; then pixels across it.
__constant float MOVE[MOVES] = {-4.0f, -2.0f, -1.0f, 0.0f, 1.0f, 2.0f, 4.0f, -2.0f, -1.0f, 1.0f, 2.0f};

__global float *row_of(__global float *values, int view, int row, int count)
{
    return values + ((view - 1) * ROWS + row) * count;
}

__kernel void sample_view(__global const float *depth, __constant float *cameras, int view, float low_pass,
                          float depth_threshold, __global const uint *z_first, __global const uchar4 *photo, int stride,
                          int across, int count, __global float *values)               // [views, ROWS, samples]
{
    const Camera target = load_camera(cameras, 0), context = load_camera(cameras, view);
    EACH(k, count)
    for (int row = 0; row < ROWS; ++row)
        row_of(values, view, row, count)[k] = NAN;
    const int2 at = sample_place(k, stride, across, target);
    const float d = depth[at.y * target.width + at.x];
    Splat splat;
    SplatDerivative dsplat_ddepth;
    float3 color;
    if (!(d > 0.0f) || !project_gaussian(target, context, at.x, at.y, d, 0.5f, low_pass, &splat, &dsplat_ddepth)
        || !look_up(photo, context, (float2)(splat.x, splat.y), &color))
        return;
    const bool hidden = splat.z > as_float(z_first[(int)splat.y * context.width + (int)splat.x]) + depth_threshold;
    row_of(values, view, HIDDEN, count)[k] = hidden ? 1.0f : 0.0f;
    const float2 moved = d * dmean_ddepth(context, turned_ray(target, context, at.x, at.y)) / (splat.z * splat.z);
    row_of(values, view, PARALLAX, count)[k] = dot(moved, moved);
    if (!hidden)
        row_of(values, view, SIZE, count)[k] = rsqrt(sqrt(splat.kxx * splat.kyy - splat.kxy * splat.kxy));
}

// 1 - correlation of the 5x5 patch around a target pixel with the context photo; depths moved by `shift` pixels of
// parallax, the photo by `off_x`, `off_y` pixels.
moves_t moved_cost(__global const float *depth, __global const float *depth_per_parallax, const Camera target,
                   const Camera context, __global const uchar4 *target_photo, __global const uchar4 *photo, int2 at,
                   moves_t shift, moves_t off_x, moves_t off_y)
{
    const moves_t none = 0.0f;
    moves_t n = none, w = none, t = none, ww = none, tt = none, wt = none, cost;
    const int next[4] = {0, context.width > 1, context.height > 1 ? context.width : 0,
                         context.width > 1 && context.height > 1 ? context.width + 1 : 0};
    EACH_AROUND(x, y, at.x, at.y, HALF, target.width, target.height) {
        const int i = y * target.width + x;
        const float3 q = turned_ray(target, context, x, y), own = rgb_of(target_photo[i]);
        const moves_t d = depth[i] + shift * depth_per_parallax[i], z = d * q.z + context.t.z, over_z = 1.0f / z;
        const moves_t u = context.fx * (d * q.x + context.t.x) * over_z + context.cx + off_x - 0.5f;
        const moves_t v = context.fy * (d * q.y + context.t.y) * over_z + context.cy + off_y - 0.5f;
        whole_t seen = (d > NEAR) & (z > NEAR) & (u >= 0.0f) & (v >= 0.0f) & (u < (float)(context.width - 1))
                     & (v < (float)(context.height - 1));
        if (!(depth[i] > 0.0f) || (SIDE_BY_SIDE == 1 && LANE(int, seen, 0) == 0))
            continue;
        const whole_t column = WHOLE(select(none, u, seen)), row = WHOLE(select(none, v, seen));
        const whole_t place = row * context.width + column;
        const moves_t a = u - TO_MOVES(column), b = v - TO_MOVES(row);
        moves_t corner[4][3], color[3];
        for (int k = 0; k < 4; ++k) {                   // as look_up has it
            whole_t pixel;
            for (int j = 0; j < SIDE_BY_SIDE; ++j)
                ((int *)&pixel)[j] = as_int(photo[LANE(int, place, j) + next[k]]);
            seen = seen & ((pixel & (int)0xff000000) != 0);
            for (int c = 0; c < 3; ++c)
                corner[k][c] = TO_MOVES((pixel >> 8 * c) & 255) * (1.0f / 255.0f);
        }
        for (int c = 0; c < 3; ++c)
            color[c] = BETWEEN(a, b, corner[0][c], corner[1][c], corner[2][c], corner[3][c]);
        const moves_t other = select(none, LUMA(color[0], color[1], color[2]), seen);
        const moves_t here = select(none, none + LUMA(own.x, own.y, own.z), seen);
        n += select(none, none + 1.0f, seen);
        w += other;
        t += here;
        ww += other * other;
        tt += here * here;
        wt += other * here;
    }
    for (int k = 0; k < SIDE_BY_SIDE; ++k) {
        const float noise = 1.5e-5f, inverse = 1.0f / fmax(LANE(float, n, k), 1.0f);
        const float of_w = LANE(float, w, k), of_t = LANE(float, t, k);
        const float var_w = LANE(float, ww, k) * inverse - of_w * of_w * inverse * inverse;
        const float var_t = LANE(float, tt, k) * inverse - of_t * of_t * inverse * inverse;
        const float both = LANE(float, wt, k) * inverse - of_w * of_t * inverse * inverse;
        ((float *)&cost)[k] = LANE(float, n, k) < LEAST_PIXELS || var_t < 4.0f * noise
            ? UNDEFINED : 1.0f - both / sqrt((fmax(var_w, 0.0f) + noise) * (var_t + noise));
    }
    return cost;
}

// Work-items (sample, SIDE_BY_SIDE moves).
__kernel void match_moved(__global const float *depth, __global const float *depth_per_parallax,
                          __constant float *cameras, int view, __global const uchar4 *target_photo,
                          __global const uchar4 *photo, int stride, int across, int count,
                          __global float *values, __global float *costs)               // [MOVES, samples]
{
    const Camera target = load_camera(cameras, 0), context = load_camera(cameras, view);
    const int k = get_global_id(0), first = SIDE_BY_SIDE * get_global_id(1);
    if (k >= count || first >= MOVES)
        return;
    moves_t cost = UNDEFINED, shift, off_x, off_y;
    if (row_of(values, view, HIDDEN, count)[k] == 0.0f) {
        const int2 at = sample_place(k, stride, across, target);
        const float2 along = dmean_ddepth(context, turned_ray(target, context, at.x, at.y));       // as depth moves it
        const float2 across_it = (float2)(-along.y, along.x) * rsqrt(fmax(dot(along, along), 1e-30f));
        for (int j = 0; j < SIDE_BY_SIDE; ++j) {
            const int move = min(first + j, MOVES - 1);
            ((float *)&shift)[j] = move < SHIFTS ? MOVE[move] : 0.0f;
            ((float *)&off_x)[j] = move < SHIFTS ? 0.0f : MOVE[move] * across_it.x;
            ((float *)&off_y)[j] = move < SHIFTS ? 0.0f : MOVE[move] * across_it.y;
        }
        cost = moved_cost(depth, depth_per_parallax, target, context, target_photo, photo, at, shift, off_x, off_y);
    }
    for (int j = 0; j < min(SIDE_BY_SIDE, MOVES - first); ++j)
        costs[(first + j) * count + k] = LANE(float, cost, j);
}

// Where five costs, at -2, -1, 0, 1, 2 pixels, are least; NaN where one is not defined or none of them matches.
float least_at(const float cost[5])
{
    int best = 0;
    bool defined = true;
    for (int j = 0; j < 5; ++j) {
        defined = defined && cost[j] < TEXTURED;
        best = cost[j] < cost[best] ? j : best;
    }
    if (!defined || cost[best] > OTHER)
        return NAN;
    if (best == 0 || best == 4)
        return best - 2.0f;
    const float before = cost[best - 1] - cost[best], after = cost[best + 1] - cost[best];
    return best - 2.0f + 0.5f * (before - after) / fmax(before + after, 1e-12f);
}

// What a view says of each sample is added to the totals.
__kernel void judge_view(__global const float *costs, __constant float *cameras, int view, int stride, int across,
                         int count, __global float *values, __global float *totals)    // [TOTALS, samples]
{
    const Camera target = load_camera(cameras, 0);
    EACH(k, count)
    float cost[MOVES], least = UNDEFINED;
    bool textured = true;
    for (int j = 0; j < MOVES; ++j) {
        cost[j] = costs[j * count + k];
        least = j < SHIFTS ? fmin(least, cost[j]) : least;
        textured = textured && (j >= SHIFTS || cost[j] < TEXTURED);
    }
    for (int j = 0; j < TOTALS; ++j) {
        const float vote = !textured ? 0.0f : j == 1 ? 1.0f : cost[max(j - 2, 0)];
        const float add = j == 0 ? row_of(values, view, HIDDEN, count)[k] == 0.0f : vote;
        totals[j * count + k] = (view == 1 ? 0.0f : totals[j * count + k]) + add;
    }
    const float here = cost[SHIFTS / 2];
    row_of(values, view, EXPLAINED, count)[k] = here < TEXTURED ? SQUARE(fmax(1.0f - here, 0.0f)) : NAN;
    row_of(values, view, LIKE, count)[k] = here < TEXTURED && (here > OTHER || here > least + WORSE) ? 0.0f : 1.0f;
    const int2 at = sample_place(k, stride, across, target);
    const int quadrant = (2 * at.x >= target.width) + 2 * (2 * at.y >= target.height);
    const float epipolar_offset[5] = {cost[SHIFTS], cost[SHIFTS + 1], here, cost[SHIFTS + 2], cost[SHIFTS + 3]};
    row_of(values, view, EPIPOLAR_OFFSET + quadrant, count)[k] = least_at(epipolar_offset);
}

// Mean over channels of what the exposure fit leaves of a match (see exposure.cl).
float left_over(__global const float *match, __global const float *exposure, int view)
{
    const float4 own = vload4(0, match), other = vload4(1, match);
    const float3 left = other.xyz - vload3(2 * view, exposure) * own.xyz - vload3(2 * view + 1, exposure);
    return (left.x + left.y + left.z) * (1.0f / 3.0f);
}

// Work-items (sample, context view - 1). Averaged over 5x5 samples: texture averages out, a highlight does not. Where
// the patches do not show the same texture, something else stands there, and it is no highlight.
__kernel void compare_colors(__global const float *matches,        // [views, samples, 8], see exposure.cl
                             __global const float *exposure, int across, int down, int views, __global float *values)
{
    const int k = get_global_id(0), view = get_global_id(1) + 1, count = across * down;
    if (k >= count || view > views)
        return;
    __global const float *match = matches + 8 * ((view - 1) * count + k);
    if (match[3] > 0.0f)
        for (int c = 0; c < 3; ++c)
            row_of(values, view, CHANGE + c, count)[k] = match[4 + c] - match[c];
    float sum = 0.0f, number = 0.0f;
    EACH_AROUND(u, v, k % across, k / across, 2, across, down) {
        const int near = v * across + u;
        __global const float *other = matches + 8 * ((view - 1) * count + near);
        if (other[3] > 0.0f && row_of(values, view, LIKE, count)[near] == 1.0f) {
            sum += left_over(other, exposure, view);
            number += 1.0f;
        }
    }
    if (number > 12.0f)
        row_of(values, view, SPECULARITY, count)[k] = fabs(sum / number);
}

// Three rows: 1 where some view sees a sample of the surface, else 0; 1 where the photos match clearly better two or
// more pixels of parallax away, 0 where they do not; mean specularity of the views. NaN where there is no surface, and
// where no view has texture.
__kernel void judge_samples(__global const float *depth, __constant float *cameras, __global const float *totals,
                            __global float *values, int views, int stride, int across, int count, __global float *rows)
{
    const Camera target = load_camera(cameras, 0);
    EACH(k, count)
    const int2 at = sample_place(k, stride, across, target);
    const float number = totals[count + k];
    float here = INFINITY, far = INFINITY;
    for (int j = 0; j < SHIFTS; ++j) {
        const float cost = totals[(j + 2) * count + k] / fmax(number, 1.0f);
        if (fabs(MOVE[j]) < 2.0f)
            here = fmin(here, cost);
        else
            far = fmin(far, cost);
    }
    rows[k] = depth[at.y * target.width + at.x] > 0.0f ? (totals[k] > 0.0f ? 1.0f : 0.0f) : NAN;
    rows[count + k] = number > 0.0f ? (far < here - 0.05f ? 1.0f : 0.0f) : NAN;
    float specularity = 0.0f, known = 0.0f;
    for (int view = 1; view <= views; ++view) {
        const float value = row_of(values, view, SPECULARITY, count)[k];
        specularity += isnan(value) ? 0.0f : value;
        known += isnan(value) ? 0.0f : 1.0f;
    }
    rows[2 * count + k] = known > 0.0f ? specularity / known : NAN;
}
