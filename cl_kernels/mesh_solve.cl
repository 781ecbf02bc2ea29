// The displacements delta of all vertices along their normals (method section 10.3): the least of
//     sum D_i w_i (delta_i - t_i)^2 + D_i stay_i delta_i^2 + lambda sum D_i soft_i (L delta)_i^2,   D_i = 1 / unit_i^2,
// L = 1 - weighted mean of the neighbours, by conjugate gradients. Every sum is a gather or a tree of fixed shape.
// Lengths are in median footprints; `pairs` and `first` as in mesh_evidence.cl, `links` the weight of each of a pair.
#include "constants.clh"
#include "linear.clh"
#include "sums.clh"

#define STILL 0.02f                      // footprints: a vertex without evidence, or on a crease, does not move by less
#define DETAIL 1.5f                      // footprints: longer edges (mean around a vertex, `reach`) are smoothed less
#define LOOSE 0.01f                      // share of a triangle's weight by which a vertex on a crease does not move
#define SHARP 0.85f                      // flatness below which a vertex lies on a crease

// Little where the surface bends or displacements part, none on a crease.
__kernel void find_links(__global const float *positions, __global const float *normals, __global const int *first,
                         __global const int2 *pairs, __global const float *delta, __global const float *flatness,
                         int count, float scale, float crease, float jump, __global float2 *links,
                         __global float *sums)                     // [V] 1 / sum of a vertex's links
{
    EACH(i, count)
    const float3 p = vload3(i, positions), n = vload3(i, normals);
    float sum = 0.0f;
    for (int k = first[i]; k < first[i + 1]; ++k) {
        float weight[2];
        for (int side = 0; side < 2; ++side) {
            const int j = side ? pairs[k].y : pairs[k].x;
            const float bend = (1.0f - dot(n, vload3(j, normals))) / crease;
            const float steep = fabs(delta[i] - delta[j])
                                / (fmax(distance(p, vload3(j, positions)) * scale, 0.3f) * jump);
            const float soft = (1.0f + bend * bend) * (1.0f + steep * steep);
            weight[side] = fmin(flatness[i], flatness[j]) < SHARP ? 0.0f : 1.0f / soft;
        }
        links[k] = (float2)(weight[0], weight[1]);
        sum += weight[0] + weight[1];
    }
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

// residual = D w t - q, with q what apply_matrix makes of delta, and the preconditioner 1 / diagonal
__kernel void start(__global const int *first, __global const int2 *pairs, __global const float2 *links,
                    __global const float *sums, __global const float *unit, __global const float *weight,
                    __global const float *target, __global const float *reach, __global const float *stay,
                    __global const float *q, int count, float scale, float lambda, __global float *inverse_diagonal,
                    __global float *residual)
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
    inverse_diagonal[i] = 1.0f / (each * (w > 0.0f ? w : stay[i]) + lambda * (soft(unit[i], reach[i]) * each + sum));
    residual[i] = each * w * target[i] * scale - q[i];
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
                  __global const float *unit, __global const float *weight, __global const float *stay, int count,
                  float scale, float lambda, __global float *q, __global float *partial)
{
    __local float scratch[GROUP];
    const int i = get_global_id(0);
    float product = 0.0f;
    if (i < count) {
        const float each = 1.0f / (unit[i] * unit[i] * scale * scale);
        q[i] = each * (weight[i] > 0.0f ? weight[i] : stay[i]) * p[i]
               + lambda * (y[i] - smoothed(y, first, pairs, links, sums, i));
        product = p[i] * q[i];
    }
    leave_sum(product, scratch, GROUP, partial);
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
    __local float scratch[GROUP];
    const int i = get_global_id(0);
    float product = 0.0f;
    if (i < count) {
        if (!first_time && scalars[2] > 0.0f) {
            const float alpha = scalars[step & 1] / scalars[2];
            delta[i] += alpha * p[i];
            residual[i] -= alpha * q[i];
        }
        product = residual[i] * residual[i] * inverse_diagonal[i];
    }
    leave_sum(product, scratch, GROUP, partial);
}

// p = z + beta p
__kernel void turn(__global const float *scalars, int step, int first_time, int count, __global const float *residual,
                   __global const float *inverse_diagonal, __global float *p)
{
    EACH(i, count)
    const float before = scalars[(step & 1) ^ 1];
    const float beta = !first_time && before > 0.0f ? scalars[step & 1] / before : 0.0f;
    p[i] = residual[i] * inverse_diagonal[i] + (first_time ? 0.0f : beta * p[i]);
}

float3 displacement_of(int i, __global const float *normals, __global const float *delta,
                       __global const float *flatness, __global const float *displacements)
{
    return flatness[i] < SHARP ? vload3(i, displacements) : delta[i] * vload3(i, normals);
}

// On creases, where normals have no sense, the displacement that takes the planes of the triangles around along with
// their other corners (least squares). With `last` it becomes direction and length: normals and delta.
__kernel void follow_planes(__global const float *positions, __global const int *first, __global const int2 *pairs,
                            __global const float *flatness, __global const float *before, int count, int last,
                            __global float *displacements, __global float *normals, __global float *delta)
{
    EACH(i, count)
    if (!(flatness[i] < SHARP))
        return;
    const float3 p = vload3(i, positions);
    float3 r0 = 0.0f, r1 = 0.0f, r2 = 0.0f, b = 0.0f;
    float total = 0.0f;
    for (int k = first[i]; k < first[i + 1]; ++k) {
        const int2 j = pairs[k];
        const float3 to_a = vload3(j.x, positions) - p, to_b = vload3(j.y, positions) - p, n = cross(to_a, to_b);
        const float area = length(n), angle = atan2(area, dot(to_a, to_b));
        if (!(area > 0.0f))
            continue;
        const float3 unit = n / area, weighed = angle * unit;
        r0 += weighed.x * unit;
        r1 += weighed.y * unit;
        r2 += weighed.z * unit;
        b += weighed * (0.5f * dot(unit, displacement_of(j.x, normals, delta, flatness, before)
                                         + displacement_of(j.y, normals, delta, flatness, before)));
        total += angle;
    }
    r0.x += LOOSE * total;
    r1.y += LOOSE * total;
    r2.z += LOOSE * total;
    const float3 displacement = solve_rows(r0, r1, r2, b);
    if (last) {
        delta[i] = length(displacement);
        vstore3(delta[i] > 0.0f ? displacement / delta[i] : (float3)(0.0f), i, normals);
    }
    vstore3(displacement, i, displacements);
}

// moved = positions + delta normals; what has no evidence and would hardly move stays where it is
__kernel void move(__global const float *positions, __global const float *normals, __global const float *unit,
                   __global const float *weight, __global const float *flatness, int count, float scale,
                   __global float *delta, __global float *moved)
{
    EACH(i, count)
    if (!(weight[i] > 0.0f && flatness[i] >= SHARP) && fabs(delta[i]) < STILL * unit[i] * scale)
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
