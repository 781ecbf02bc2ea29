// The ways delta of all vertices along their normals (method section 10.3): the least of
//     sum D_i w_i (delta_i - t_i)^2 + D_i stay_i delta_i^2 + lambda sum D_i soft_i (L delta)_i^2,   D_i = 1 / unit_i^2,
// L = 1 - weighted mean of the neighbours, by conjugate gradients. Every sum is a gather or a tree of fixed shape.
// Lengths are in median footprints; `pairs` and `first` as in mesh_evidence.cl, `links` the weight of each of a pair.
//   find_links  weights between neighbours: little across a crease, or where their ways part
//   find_sums   their sums, and with them the preconditioner
//   apply_laplacian, apply_matrix, advance, turn   a step of conjugate gradients; add_up the tree's root
//   hold_back   halves the ways of triangles that would turn over
#include "constants.clh"
#include "sums.clh"

#define STILL 0.02f                      // footprints
#define DETAIL 1.5f                      // footprints: longer edges (mean around a vertex, `reach`) are smoothed less

#define EACH_IN_GROUP(i) \
    const int i = get_global_id(0); \
    __local float scratch[GROUP];

__kernel void find_links(__global const float *positions, __global const float *normals, __global const int *first,
                         __global const int2 *pairs, __global const float *delta, int count, float scale, float crease,
                         float jump, __global float2 *links)
{
    EACH(i, count)
    const float3 p = vload3(i, positions), n = vload3(i, normals);
    for (int k = first[i]; k < first[i + 1]; ++k) {
        float weight[2];
        for (int side = 0; side < 2; ++side) {
            const int j = side ? pairs[k].y : pairs[k].x;
            const float bend = (1.0f - dot(n, vload3(j, normals))) / crease;
            const float steep = fabs(delta[i] - delta[j])
                                / (fmax(distance(p, vload3(j, positions)) * scale, 0.3f) * jump);
            weight[side] = 1.0f / ((1.0f + bend * bend) * (1.0f + steep * steep));
        }
        links[k] = (float2)(weight[0], weight[1]);
    }
}

// sums: [V] 1 / sum of a vertex's links
__kernel void find_sums(__global const int *first, __global const float2 *links, int count, __global float *sums)
{
    EACH(i, count)
    float sum = 0.0f;
    for (int k = first[i]; k < first[i + 1]; ++k)
        sum += links[k].x + links[k].y;
    sums[i] = sum > 0.0f ? 1.0f / sum : 0.0f;
}

float soft(float unit, float reach)
{
    const float ratio = fmin(1.0f, DETAIL * unit / reach);
    return ratio * ratio;
}

float smoothed(__global const float *x, __global const int *first, __global const int2 *pairs,
               __global const float2 *links, __global const float *factor, int i)
{
    float sum = 0.0f;
    for (int k = first[i]; k < first[i + 1]; ++k)
        sum += links[k].x * x[pairs[k].x] * (factor ? factor[pairs[k].x] : 1.0f)
             + links[k].y * x[pairs[k].y] * (factor ? factor[pairs[k].y] : 1.0f);
    return sum;
}

// residual = D w t (delta = 0), and the preconditioner 1 / diagonal
__kernel void start(__global const int *first, __global const int2 *pairs, __global const float2 *links,
                    __global const float *sums, __global const float *unit, __global const float *weight,
                    __global const float *target, __global const float *reach, int count, float scale, float lambda,
                    float stay, __global float *inverse_diagonal, __global float *residual, __global float *delta)
{
    EACH(i, count)
    const float each = 1.0f / (unit[i] * unit[i] * scale * scale), w = weight[i];
    float sum = 0.0f;
    for (int k = first[i]; k < first[i + 1]; ++k) {
        const int2 j = pairs[k];
        const float a = links[k].x * sums[j.x] / (unit[j.x] * scale), b = links[k].y * sums[j.y] / (unit[j.y] * scale);
        // an edge lies in two triangles, which are counted one by one
        sum += 2.0f * (soft(unit[j.x], reach[j.x]) * a * a + soft(unit[j.y], reach[j.y]) * b * b);
    }
    inverse_diagonal[i] = 1.0f / (each * (w > 0.0f ? w : stay) + lambda * (soft(unit[i], reach[i]) * each + sum));
    residual[i] = each * w * target[i] * scale;
    delta[i] = 0.0f;
}

// y = D L x
__kernel void apply_laplacian(__global const float *x, __global const int *first, __global const int2 *pairs,
                              __global const float2 *links, __global const float *sums, __global const float *unit,
                              __global const float *reach, int count, float scale, __global float *y)
{
    EACH(i, count)
    const float each = 1.0f / (unit[i] * unit[i] * scale * scale);
    const float bent = x[i] - sums[i] * smoothed(x, first, pairs, links, 0, i);
    y[i] = sums[i] > 0.0f ? soft(unit[i], reach[i]) * each * bent : 0.0f;
}

// q = D (w + stay) p + lambda L^T y, and the sum of p q by groups
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void apply_matrix(__global const float *p, __global const float *y, __global const int *first,
                  __global const int2 *pairs, __global const float2 *links, __global const float *sums,
                  __global const float *unit, __global const float *weight, int count, float scale, float lambda,
                  float stay, __global float *q, __global float *partial)
{
    EACH_IN_GROUP(i)
    float product = 0.0f;
    if (i < count) {
        const float each = 1.0f / (unit[i] * unit[i] * scale * scale);
        q[i] = each * (weight[i] > 0.0f ? weight[i] : stay) * p[i]
               + lambda * (y[i] - smoothed(y, first, pairs, links, sums, i));
        product = p[i] * q[i];
    }
    const float sum = sum_of_group(product, scratch, GROUP);
    if (get_local_id(0) == 0)
        partial[get_group_id(0)] = sum;
}

// scalars[which] = the sum of all partial sums; one work-group
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void add_up(__global const float *partial, int groups, int which, __global float *scalars)
{
    __local float scratch[GROUP];
    float sum = 0.0f;
    for (int k = get_local_id(0); k < groups; k += GROUP)
        sum += partial[k];
    sum = sum_of_group(sum, scratch, GROUP);
    if (get_local_id(0) == 0)
        scalars[which] = sum;
}

// alpha = rz / pq; delta += alpha p; r -= alpha q; and the sum of r z, z = r / diagonal, by groups. scalars: rz of even
// steps, of odd ones, pq. With `first_time` nothing is moved.
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void advance(__global const float *scalars, int step, int first_time, int count, __global const float *p,
             __global const float *q, __global const float *inverse_diagonal, __global float *delta,
             __global float *residual, __global float *partial)
{
    EACH_IN_GROUP(i)
    float product = 0.0f;
    if (i < count) {
        if (!first_time && scalars[2] > 0.0f) {
            const float alpha = scalars[step & 1] / scalars[2];
            delta[i] += alpha * p[i];
            residual[i] -= alpha * q[i];
        }
        product = residual[i] * residual[i] * inverse_diagonal[i];
    }
    const float sum = sum_of_group(product, scratch, GROUP);
    if (get_local_id(0) == 0)
        partial[get_group_id(0)] = sum;
}

// p = z + beta p
__kernel void turn(__global const float *scalars, int step, int first_time, int count, __global const float *residual,
                   __global const float *inverse_diagonal, __global float *p)
{
    EACH(i, count)
    const float before = scalars[(step & 1) ^ 1], beta = !first_time && before > 0.0f ? scalars[step & 1] / before : 0.0f;
    p[i] = residual[i] * inverse_diagonal[i] + (first_time ? 0.0f : beta * p[i]);
}

// moved = positions + delta normals; what has no evidence and would hardly move stays where it is
__kernel void move(__global const float *positions, __global const float *normals, __global const float *unit,
                   __global const float *weight, int count, float scale, __global float *delta, __global float *moved)
{
    EACH(i, count)
    if (!(weight[i] > 0.0f) && fabs(delta[i]) < STILL * unit[i] * scale)
        delta[i] = 0.0f;
    vstore3(vload3(i, positions) + (delta[i] / scale) * vload3(i, normals), i, moved);
}

// held[i]: how often vertex i was held back, since a triangle around it turned over; the last time it stays
__kernel void hold_back(__global const float *positions, __global const float *moved, __global const int *first,
                        __global const int2 *pairs, int count, int last, __global float *delta, __global int *held)
{
    EACH(i, count)
    const float3 p = vload3(i, positions), q = vload3(i, moved);
    bool turned = false;
    for (int k = first[i]; k < first[i + 1] && !turned; ++k) {
        const float3 before = cross(vload3(pairs[k].x, positions) - p, vload3(pairs[k].y, positions) - p);
        const float3 after = cross(vload3(pairs[k].x, moved) - q, vload3(pairs[k].y, moved) - q);
        turned = dot(before, after) < 0.04f * dot(before, before);
    }
    if (turned && delta[i] != 0.0f) {
        delta[i] = last ? 0.0f : 0.5f * delta[i];
        held[i] += 1;
    }
}
