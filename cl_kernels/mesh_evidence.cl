// What the depth maps say of a mesh's vertices, each along its normal (method section 10.2). Lengths in units of the
// mesh's size; `pairs` holds, vertex after vertex, the two other corners of each triangle around it, `first` where each
// vertex's begin.
#include "constants.clh"
#include "eye.clh"
#include "lanes.clh"

#define FACING 0.15f
#define ON_SURFACE 1.0f                  // footprints (more on slopes) between a seen vertex and the drawn mesh
#define REACH 0.5f                       // of the mean edge around a vertex: depths that count,
#define MOST_REACH 12                    // pixels at most
#define WINDOW 1                         // pixels around a depth that must lie on one surface with it (NO_EDGE),
#define ALONE 3                          // the same where no other view need confirm it,
#define STEEP 0.87f                      // no steeper than this to its tangent plane: sine,
#define NEAR 0.3f                        // but for so many footprints
#define LEAST_SIGMA 0.1f                 // footprints: no depth is surer
#define OUTLIER 1.0f                     // footprints from the median from which on an observation does not count
#define DOUBT 0.3f                       // the same from which on it counts less

// the ray through a pixel's centre, with z = 1
#define RAY_X(column) (((column) + 0.5f - eye.cx) * eye.ifx)
#define RAY_Y(row) (((row) + 0.5f - eye.cy) * eye.ify)

// Mean of the normals around a vertex, by angle.
__kernel void vertex_normals(__global const float *positions, __global const int *first, __global const int2 *pairs,
                             int count, __global float *normals,                       // [V, 3], unit length or zero
                             __global float *reach,                                    // [V] mean edge
                             __global float *flatness)                                 // [V] 1 where normals are alike
{
    EACH(i, count)
    const float3 p = vload3(i, positions);
    float3 sum = 0.0f;
    float edges = 0.0f, angles = 0.0f;
    for (int k = first[i]; k < first[i + 1]; ++k) {
        const float3 a = vload3(pairs[k].x, positions) - p, b = vload3(pairs[k].y, positions) - p;
        const float3 across = cross(a, b);
        const float area = length(across);
        edges += length(a) + length(b);
        if (area > 0.0f) {
            const float angle = atan2(area, dot(a, b));
            angles += angle;
            sum += across * (angle / area);
        }
    }
    const float size = length(sum);
    flatness[i] = angles > 0.0f ? size / angles : 1.0f;
    reach[i] = edges / (2 * max(first[i + 1] - first[i], 1));
    vstore3(size > 1e-6f ? sum / size : (float3)(0.0f), i, normals);
}

// In the middle of the edges between `pairs`: place, normal, and mean edge when they are split there.
__kernel void edge_middles(__global const float *positions, __global const float *normals, __global const int2 *pairs,
                           int count, __global float *middles, __global float *directions, __global float *reach)
{
    EACH(i, count)
    const float3 a = vload3(pairs[i].x, positions), b = vload3(pairs[i].y, positions);
    const float3 sum = vload3(pairs[i].x, normals) + vload3(pairs[i].y, normals);
    const float size = length(sum);
    vstore3(0.5f * (a + b), i, middles);
    vstore3(size > 1e-6f ? sum / size : (float3)(0.0f), i, directions);
    reach[i] = 0.5f * distance(a, b);
}

// Whether the surface goes on from `own`, along n, to all pixels no more than `far` away from (column, row).
bool goes_on(const Eye eye, __global const float *depth, int column, int row, int far, float scale, float3 own,
             float3 n, float size)
{
    if (!(min(column, row) >= far && column + far < eye.width && row + far < eye.height))
        return false;
    for (int y = row - far; y <= row + far; ++y)
        for (int start = column - far; start <= column + far; start += COLUMNS) {
            const mask_t x = start + LANE_NUMBERS;
            const columns_t d = scale * load_around(depth, start, y, eye.width, eye.height);
            const columns_t ax = d * RAY_X(TO_COLUMNS(x)) - own.x, ay = d * RAY_Y(y) - own.y, az = d - own.z;
            const columns_t apart = fabs(ax * n.x + ay * n.y + az * n.z), away = sqrt(ax * ax + ay * ay + az * az);
            const mask_t same = (d > 0.0f) & (apart <= fmin((columns_t)(NO_EDGE * size), STEEP * away));
            if (ANY((x <= column + far) & (same == 0)))
                return false;
        }
    return true;
}

float sum_of(columns_t values)
{
    float sum = 0.0f;
    for (int k = 0; k < COLUMNS; ++k)
        sum += LANE(float, values, k);
    return sum;
}

// observations: [V, SLOTS] displacement along the normal and weight, the weightiest of all views, one view after the
// other.
__kernel void gather(__global const float *positions, __global const float *normals, int count,
                     __constant float *camera,
                     __global const float *drawn,                  // [H, W] of the mesh as it is, units
                     __global const float *depth, __global const float *deviation, float scale,   // [H, W] scene units
                     float orientation,                            // of normals: 1 outwards, -1 inwards, 0 as it comes
                     __global const float *reach, int least_views,     // from 2 on
                     __global float2 *observations,
                     __global int *seen,                           // [V] views that the vertex is not hidden from
                     __global float *unit)                         // [V] least footprint among the views, units
{
    EACH(i, count)
    const Eye eye = load_eye(camera);
    const float3 away = vload3(i, positions) - eye.center, normal = vload3(i, normals);
    const float3 p = (float3)(dot(eye.r0, away), dot(eye.r1, away), dot(eye.r2, away));
    const float3 n = (float3)(dot(eye.r0, normal), dot(eye.r1, normal), dot(eye.r2, normal));
    const float cosine = -dot(p, n) / length(p), facing = orientation == 0.0f ? fabs(cosine) : orientation * cosine;
    if (!(p.z > 0.0f && facing > FACING))
        return;
    const float u = eye.fx * p.x / p.z + eye.cx, v = eye.fy * p.y / p.z + eye.cy;
    if (!(u > WINDOW + 0.5f && v > WINDOW + 0.5f && u < eye.width - WINDOW - 0.5f && v < eye.height - WINDOW - 0.5f))
        return;
    const float size = p.z * sqrt(eye.ifx * eye.ify);
    const int column = (int)u, row = (int)v, middle = row * eye.width + column;
    const float tangent = sqrt(1.0f / (facing * facing) - 1.0f);
    if (!(drawn[middle] > 0.0f && fabs(drawn[middle] - p.z) < ON_SURFACE * size * (1.0f + tangent)))
        return;
    unit[i] = fmin(unit[i], size);
    const float3 own = depth[middle] * scale * (float3)(RAY_X(column), RAY_Y(row), 1.0f);
    const bool smooth = depth[middle] > 0.0f && isfinite(deviation[middle])
                        && goes_on(eye, depth, column, row, WINDOW, scale, own, n, size);
    // a vertex with that many other observations needs none that may stand alone
    __global float2 *own_slots = observations + i * SLOTS;
    const bool alone = smooth && !(own_slots[min(least_views, SLOTS + 1) - 2].y > 0.0f)
                       && goes_on(eye, depth, column, row, ALONE, scale, own, n, size);
    seen[i] += alone ? 257 : 1;
    if (!smooth)
        return;
    const float wide = REACH * reach[i], least = LEAST_SIGMA * size;
    const int far = min((int)ceil(wide / size), MOST_REACH);
    columns_t sure = ZERO, near = ZERO, moved = ZERO;
    for (int y = max(row - far, 0); y <= min(row + far, eye.height - 1); ++y)
        for (int start = column - far; start <= column + far; start += COLUMNS) {
            const mask_t x = start + LANE_NUMBERS;
            const columns_t mesh = load_around(drawn, start, y, eye.width, eye.height), rx = RAY_X(TO_COLUMNS(x));
            const columns_t d = load_around(depth, start, y, eye.width, eye.height) * scale;
            const columns_t spread = load_around(deviation, start, y, eye.width, eye.height) * scale;
            const float ry = RAY_Y(y);
            const columns_t slope = rx * n.x + (ry * n.y + n.z), off = (d - mesh) * slope;
            const columns_t ax = mesh * rx - p.x, ay = mesh * ry - p.y, az = mesh - p.z;
            const columns_t away = sqrt(ax * ax + ay * ay + az * az), share = 1.0f - away / wide;
            const mask_t counts = (x <= column + far) & (mesh > 0.0f) & (d > 0.0f) & (spread < INFINITY)
                                  & (share > 0.0f) & (fabs(off) < NO_EDGE * size)
                                  & (fabs(ax * n.x + ay * n.y + az * n.z) < STEEP * away + NEAR * size);
            const columns_t low = fmax(spread * fabs(slope), (columns_t)(least));
            const columns_t weight = select(ZERO, share / (low * low), counts);
            sure += weight;
            near += select(ZERO, share, counts);
            moved += select(ZERO, weight * off, counts);
        }
    float total = sum_of(sure), shares = sum_of(near), shift = sum_of(moved);
    if (!(total > 0.0f)) {                 // no pixel's centre is so near: between four; 1 / depth is linear on planes
        const int left = (int)floor(u - 0.5f), top = (int)floor(v - 0.5f);
        const float a = u - 0.5f - left, b = v - 0.5f - top, slope = dot(p, n) / p.z;
        __global const float *corner = depth + top * eye.width + left;
        const float d = scale / ((1.0f - b) * ((1.0f - a) / corner[0] + a / corner[1])
                                 + b * ((1.0f - a) / corner[eye.width] + a / corner[eye.width + 1]));
        const float low = fmax(deviation[middle] * scale * fabs(slope), least);
        shift = (d - p.z) * slope / (low * low);
        total = 1.0f / (low * low);
        shares = 1.0f;
    }
    float2 observation = (float2)(shift / total, facing * facing * facing * facing * total / shares);
    for (int k = 0; k < SLOTS && observation.y > 0.0f; ++k)
        if (observation.y > own_slots[k].y) {
            const float2 out = own_slots[k];
            own_slots[k] = observation;
            observation = out;
        }
}

// target: where the vertex is said to be, along its normal; weight: in 1 / unit^2, at most MOST_WEIGHT and 0 with fewer
// than LEAST_VIEWS views that agree; seen: how many do; sigma: the standard deviation of the target, units.
__kernel void resolve(__global const float2 *observations, __global const float *unit, int count, int least_views,
                      __global float *target, __global float *weight, __global int *seen, __global float *sigma)
{
    EACH(i, count)
    float2 observation[SLOTS];
    float total = 0.0f;
    int number = 0;
    for (int k = 0; k < SLOTS; ++k) {
        const float2 next = observations[i * SLOTS + k];
        if (!(next.y > 0.0f))
            break;
        int place = number++;
        for (; place > 0 && observation[place - 1].x > next.x; --place)
            observation[place] = observation[place - 1];
        observation[place] = next;
        total += next.y;
    }
    float below = 0.0f, median = 0.0f;
    for (int k = 0; k < number; ++k) {
        below += observation[k].y;
        if (below >= 0.5f * total) {
            median = observation[k].x;
            break;
        }
    }
    float sum = 0.0f, shift = 0.0f;
    int agree = 0;
    for (int k = 0; k < number; ++k) {
        const float apart = fabs(observation[k].x - median) / unit[i];
        if (apart > OUTLIER)
            continue;
        const float share = observation[k].y / fmax(1.0f, apart / DOUBT);
        sum += share;
        shift += share * observation[k].x;
        ++agree;
    }
    const bool enough = agree >= least_views || (agree > 0 && agree == number && seen[i] / 256 == number
                                                    && seen[i] % 256 >= least_views);
    target[i] = enough ? shift / sum : 0.0f;
    weight[i] = enough ? MOST_WEIGHT * WEIGHT_SHARE * sum * unit[i] * unit[i] / agree : 0.0f;
    seen[i] = agree;
    sigma[i] = enough ? rsqrt(sum) : INFINITY;
}
