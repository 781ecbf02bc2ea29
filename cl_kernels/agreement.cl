// Refined depth maps of other views as evidence for one another (method section 8.1). Lengths in units; `scale` is
// units per scene unit, in which the maps come; IN_COMMON the share of their variance that views have in common.
#define CAMERA_SPACE __global const      // all views of a scene at once, more than constant memory may hold
#include "camera.clh"

#define EDGE 3.0f                        // pixels of parallax: corners of a cell that differ by more are two surfaces
#define MOST_UNSURE 0.5f                 // pixels of parallax: more than that a deviation does not count
#define LENIENCE 2.0f                    // of `spread`: weights know no smaller deviation
#define TWICE 2.0f                       // each pair of photos is seen by two views
#define CONFIRMS 0.5f                    // pixels of parallax within which a depth is confirmed
#define AROUND 2                         // half the width of the surroundings that a scatter is taken from

// Variance that a depth counts with: its own deviation as far as it can be believed, and what maps differ by.
#define VARIANCE(s, u, floor) (SQUARE(fmin(s, MOST_UNSURE * (u))) + SQUARE((floor) * (u)))

// Inverse depth that photos confirm, 0 for any other.
#define CONFIRMED(status, depth, deviation) \
    ((status) == REFINED && (deviation) < INFINITY && (depth) > 0.0f ? 1.0f / (depth) : 0.0f)

__kernel void invert(int count, __global const float *depth, __global const float *deviation,
                     __global const uchar *status, __global float *inverse)
{
    EACH(i, count)
    inverse[i] = CONFIRMED(status[i], depth[i], deviation[i]);
}

// Sum of the second differences at the two middle ones of four inverse depths, `stride` apart, the second one at `place`;
// 0 where the outer ones are not `inside` or are of another surface.
columns_t sum_of_bends(__global const float *inverses, float scale, mask_t place, int stride, mask_t inside,
                       columns_t first, columns_t second, columns_t limit)
{
    const columns_t before = pick(inverses, select(place, place - stride, inside)) / scale;
    const columns_t after = pick(inverses, select(place, place + 2 * stride, inside)) / scale;
    const mask_t same = inside & (before > 0.0f) & (after > 0.0f) & (fabs(before - first) < limit)
                        & (fabs(after - second) < limit);
    return select(ZERO, before - first - second + after, same);
}

// How much the target's depths would have to change for their points to lie on the other view's surface: inverse depth w
// between the four pixels around them, with what it bends there, or averages would flatten fine detail. It is nearly
// linear in the image, so that z w = 1 is solved by one step. And deviations of that view there. Returns where it says
// anything: it sees the point, all four have a refined depth, and there is no depth edge between them.
mask_t difference(const Camera target, CAMERA_SPACE float *cameras, int view, int column, int row, float scale,
                  __global const float *depth, columns_t u, __global const float *inverses,
                  __global const float *deviations, columns_t *change, columns_t *unsure)
{
    const Camera other = load_camera(cameras, view);
    const columns_t d = LOAD_COLUMNS(depth + row * target.width + column) * scale;
    columns_t q[3], w[4];
    turned_rays(target, other, column, row, q);
    const columns_t z = d * q[2] + other.t.z, inverse_z = 1.0f / z;
    const columns_t x = other.fx * (d * q[0] + other.t.x) * inverse_z + other.cx - 0.5f;
    const columns_t y = other.fy * (d * q[1] + other.t.y) * inverse_z + other.cy - 0.5f;
    mask_t known = (d > 0.0f) & (u > 0.0f) & (z > NEAR) & (x >= 0.0f) & (y >= 0.0f) & (x < other.width - 1.0f)
                   & (y < other.height - 1.0f);
    if (!ONE_PIXEL && !ANY(known))      // work-items that have returned are not safe from Intel's vectorizer for CPUs
        return known;
    const columns_t inside_x = select(ZERO, x, known), inside_y = select(ZERO, y, known);
    const mask_t left = TO_WHOLE(inside_x), top = TO_WHOLE(inside_y), corner = top * other.width + left;
    const columns_t a = inside_x - TO_COLUMNS(left), b = inside_y - TO_COLUMNS(top);
    columns_t least = (columns_t)(INFINITY), most = ZERO;
    *unsure = ZERO;
    for (int k = 0; k < 4; ++k) {
        const mask_t place = corner + (k >> 1) * other.width + (k & 1);
        w[k] = pick(inverses, place) / scale;
        least = fmin(least, w[k]);
        most = fmax(most, w[k]);
        *unsure = fmax(*unsure, pick(deviations, place) * scale);
    }
    const columns_t slope_x = (1 - b) * (w[1] - w[0]) + b * (w[3] - w[2]);
    const columns_t slope_y = (1 - a) * (w[2] - w[0]) + a * (w[3] - w[1]);
    const columns_t limit = EDGE * u * least * most;
    const mask_t in_row = (left > 0) & (left < other.width - 2), in_column = (top > 0) & (top < other.height - 2);
    const columns_t along_x = (1 - b) * sum_of_bends(inverses, scale, corner, 1, in_row, w[0], w[1], limit)
        + b * sum_of_bends(inverses, scale, corner + other.width, 1, in_row, w[2], w[3], limit);
    const columns_t along_y = (1 - a) * sum_of_bends(inverses, scale, corner, other.width, in_column, w[0], w[2], limit)
        + a * sum_of_bends(inverses, scale, corner + 1, other.width, in_column, w[1], w[3], limit);
    const columns_t mean = BETWEEN(a, b, w[0], w[1], w[2], w[3])
                           - 0.25f * (a * (1 - a) * along_x + b * (1 - b) * along_y);
    const columns_t moved = slope_x * other.fx * MEAN_SLOPE(q[0], q[2], other.t.x, other.t.z)
                            + slope_y * other.fy * MEAN_SLOPE(q[1], q[2], other.t.y, other.t.z);
    const columns_t d_zw = q[2] * mean + moved * inverse_z;                    // d (z w) / d depth
    *change = (1.0f - z * mean) / d_zw;
    return known & (least > 0.0f) & (most - least < limit) & (d_zw > 0.0f);
}

// How often differences are so large, in bins of pixels of parallax; beyond BINS / PER_PIXEL views mean different
// surfaces. Of every `stride`-th row.
__kernel void count_differences(__global const float *depth, __global const float *inverse,
                                __global const float *depth_per_parallax, CAMERA_SPACE float *cameras, int view,
                                float scale, __global const float *inverses, __global const float *deviations,
                                int stride, int bins, float per_pixel, __global uint *counts)
{
    const Camera target = load_camera(cameras, 0);
    const int row = get_global_id(1) * stride + stride / 2;
    if (row >= target.height)
        return;
    EACH_VECTOR(item, target.width) {
        const int column = span_start(item, COLUMNS, target.width), i = row * target.width + column;
        const columns_t u = LOAD_COLUMNS(depth_per_parallax + i) * scale;
        columns_t change, unsure;
        const mask_t known = difference(target, cameras, view, column, row, scale, depth, u, inverses, deviations,
                                        &change, &unsure) & (LOAD_COLUMNS(inverse + i) > 0.0f);
        const columns_t bin = select((columns_t)(-1.0f), fabs(change) / u * per_pixel, known);
        for (int k = item * COLUMNS - column; k < COLUMNS; ++k)
            if (LANE(float, bin, k) >= 0.0f && LANE(float, bin, k) < bins)
                atomic_inc(counts + (int)LANE(float, bin, k));
    }
}

// What another view says of each depth, weighted by deviations.
__kernel void add_view(__global const float *depth, __global const float *depth_per_parallax,      // scene units
                       CAMERA_SPACE float *cameras, int view, float scale, __global const float *inverses,
                       __global const float *deviations, float spread, float pixels,
                       __global float *sums)        // [5, H, W] w change, w, w^2, w times variances, w times change^2
{
    const Camera target = load_camera(cameras, 0);
    const int row = get_global_id(1), count = target.width * target.height;
    if (row >= target.height)
        return;
    EACH_VECTOR(item, target.width) {
        const int column = span_start(item, COLUMNS, target.width), i = row * target.width + column;
        const int first = item * COLUMNS - column;
        const columns_t u = LOAD_COLUMNS(depth_per_parallax + i) * scale;
        columns_t change, unsure;
        mask_t known = difference(target, cameras, view, column, row, scale, depth, u, inverses, deviations, &change,
                                  &unsure);
        const columns_t off = change / (pixels * u);
        known &= off * off < 1.0f;
        if (!ANY(known))
            continue;
        const columns_t w = select(ZERO, taper(off * off) / VARIANCE(unsure, u, LENIENCE * spread), known);
        add_columns(sums + i, select(ZERO, w * change, known), first);
        add_columns(sums + count + i, w, first);
        add_columns(sums + 2 * count + i, w * w, first);
        add_columns(sums + 3 * count + i, select(ZERO, w * VARIANCE(unsure, u, 0.0f), known), first);
        add_columns(sums + 4 * count + i, select(ZERO, w * change * change, known), first);
    }
}

// Of the depths that a pixel may have (edges.cl), which does another view confirm, +1, and which would it have to see
// through, -1: its surface at the place is behind it.
__kernel void count_support(__global const float *candidates, int number,      // [number, H, W], its own first
                            __global const float *depth_per_parallax,          // scene units
                            CAMERA_SPACE float *cameras, int view, float scale, __global const float *inverses,
                            __global char *support)                            // [number, H, W]
{
    const Camera target = load_camera(cameras, 0), other = load_camera(cameras, view);
    EACH_PIXEL(column, row, i, target.width, target.height)
    const int count = target.width * target.height;
    const float own = candidates[i], pixel = CONFIRMS * depth_per_parallax[i] * scale * own * own;    // inverse depth
    if (!(own > 0.0f))
        return;
    const float3 q = turned_ray(target, other, column, row);
    for (int k = 0; k < number; ++k) {
        const float inverse = candidates[k * count + i];
        if (!(inverse > 0.0f))
            continue;
        const float3 mean = project_ray(other, q, 1.0f / inverse);
        const float x = mean.x - 0.5f, y = mean.y - 0.5f;
        if (!(mean.z > NEAR && x >= 0.0f && y >= 0.0f && x < other.width - 1.0f && y < other.height - 1.0f))
            continue;
        const float there = 1.0f / mean.z, within = pixel * fabs(q.z) * SQUARE(there / inverse);
        float least = INFINITY, most = 0.0f;
        bool confirms = false;
        for (int corner = 0; corner < 4; ++corner) {
            const int at = ((int)y + (corner >> 1)) * other.width + (int)x + (corner & 1);
            const float found = inverses[at] / scale;
            confirms |= found > 0.0f && fabs(found - there) < within;
            least = fmin(least, found);
            most = fmax(most, found);
        }
        support[k * count + i] += confirms - (least > 0.0f && there > most + within);
    }
}

// Mean square of the changes around a pixel, weighted as they are.
float scatter_around(__global const float *sums, int width, int height, int column, int row)
{
    const int count = width * height;
    float squares = 0.0f, weight = 0.0f;
    EACH_AROUND(x, y, column, row, AROUND, width, height) {
        weight += sums[count + y * width + x];
        squares += sums[4 * count + y * width + x];
    }
    return squares / weight;
}

// status: of the depth as it is; one that was rejected has no weight of its own, and where the others are to `propose`
// another one that is refined from then on. wider: variance of a depth over the mean square of the changes around it.
__kernel void average(int width, int height, float scale, float spread, float wider, int propose,
                      __global const float *sums, __global const float *depth, __global const float *depth_per_parallax,
                      __global const float *deviation, __global const uchar *status, __global float *averaged,
                      __global float *surer, __global uchar *found)
{
    EACH_PIXEL(column, row, i, width, height)
    const int count = width * height;
    const float total = sums[i], others = sums[count + i];
    averaged[i] = depth[i];
    surer[i] = deviation[i];
    found[i] = status[i];
    if (!(others > 0.0f) || (status[i] != REFINED && !propose))
        return;
    const float u = depth_per_parallax[i] * scale, s = deviation[i] * scale;
    const bool own = status[i] == REFINED && s < INFINITY;
    const float w = own ? 1.0f / VARIANCE(s, u, LENIENCE * spread) : 0.0f, weight = others + w;
    const float reported = (sums[3 * count + i] + w * VARIANCE(s, u, 0.0f)) / weight;
    const float apart = wider * scatter_around(sums, width, height, column, row);
    const float apart_on_average = 2.0f * wider * SQUARE(spread * u);
    const float most = wider > 0.0f ? fmax(apart, apart_on_average) : INFINITY;
    const float alone = fmin(1.0f, TWICE * (sums[2 * count + i] + w * w) / (weight * weight));
    const float left = IN_COMMON + (1.0f - IN_COMMON) * alone;
    float variance = (fmin(reported, most) + apart) * left;
    if (own)      // next to edges maps are apart that show two surfaces
        variance = fmin(variance, fmax(s * s, apart_on_average * left));
    averaged[i] = depth[i] + total / weight / scale;
    surer[i] = sqrt(variance) / scale;
    found[i] = REFINED;
}

// What no view has confirmed (`proposed`: status that `average` found), or the photos speak against, is as it was.
__kernel void keep_agreed(int count, __global const uchar *proposed, __global const float *own_depth,
                          __global const float *own_deviation, __global const uchar *own_status,
                          __global const float *depth, __global const float *depth_per_parallax,
                          __global const float *deviation, __global const uchar *status,          // after the steps
                          __global float *agreed, __global float *parallax, __global float *surer,
                          __global uchar *found, __global float *inverse)
{
    EACH(i, count)
    const bool held = proposed[i] == REFINED && status[i] == REFINED;
    agreed[i] = held ? depth[i] : own_depth[i];
    surer[i] = held ? deviation[i] : own_deviation[i];
    found[i] = held ? status[i] : own_status[i];
    parallax[i] = depth_per_parallax[i];
    inverse[i] = CONFIRMED(found[i], agreed[i], surer[i]);
}
