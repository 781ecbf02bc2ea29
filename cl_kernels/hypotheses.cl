// Depths along a pixel's ray, scored by how photos correlate (method section 8.2). A hypothesis is a plane. `places` are
// the pixels that are searched, `count` of them; each has `number` hypotheses at a time, planes[number, count, 3].
//   find_planes       the initial depth as planes
//   take_planes       hypotheses: planes as they are
//   sweep_planes      hypotheses: planes moved by whole pixels of parallax
//   shift_planes      hypotheses: planes moved by less than a pixel of parallax, the middle one not at all
//   spread_planes     hypotheses: the planes of pixels around, as far as they reach this one
//   score_planes      1 - correlation of a patch with one context photo under each hypothesis
//   choose_planes     the hypothesis that most context photos agree with, where it is better than what was there
//   accept_planes     whether the found plane is clearly better than the initial one, in three context photos or two
//   keep_supported    the depth of accepted planes that their surroundings confirm
#include "lookup.clh"
#include "planes.clh"

#define HALF 3                           // half the width of a patch; every other pixel of it is compared
#define LEAST_SAMPLES 15                 // of a patch must be inside the photo; where only those of the same surface
#define LEAST_SAME 7                     // count, fewer
#define SAME 1.5f                        // pixels of parallax within which a pixel lies on the plane of another one
#define BETTER 0.1f                      // by how much the cost must fall in three photos, two where there are fewer,
#define GAINED 0.3f                      // and in their mean, where costs above 1 say no more than 1
#define MATCHES 0.5f                     // cost above which photos do not match
#define WITHIN_REACH 2.0f                // pixels of parallax that the steps reach by themselves, and more smoothly
#define SHIFT 0.25f                      // pixels of parallax between planes of shift_planes
#define SUPPORT 10                       // of the 24 pixels around, which must lie on the plane within a pixel

__kernel void find_planes(__global const float *depth, int width, int height, __global float *surface)  // [H, W, 3]
{
    EACH_PIXEL(x, y, i, width, height)
    vstore3(plane_at(depth, x, y, width, height), i, surface);
}

// Pixels by which a point moves in the context photos where its inverse depth grows by one, their mean; 0: none sees it
float pixels_per_inverse(__constant float *cameras, int views, int x, int y, float inverse)
{
    const Camera target = load_camera(cameras, 0);
    float sum = 0.0f, number = 0.0f;
    for (int view = 1; view <= views; ++view) {
        const Camera context = load_camera(cameras, view);
        const float3 q = turned_ray(target, context, x, y), m = project_ray(context, q, 1.0f / inverse);
        if (!(m.z > NEAR) || !in_image(context, m))
            continue;
        const float z = q.z + inverse * context.t.z;           // of the mean times the inverse depth
        sum += length(dmean_ddepth(context, q)) / (z * z);
        number += 1.0f;
    }
    return number > 0.0f ? sum / number : 0.0f;
}

// The planes of the places themselves as hypothesis number `row`.
__kernel void take_planes(__global const float *source,            // [H, W, 3]
                          __global const int *places, int first, int count, int row, __global float *planes)
{
    EACH(k, count)
    vstore3(vload3(places[first + k], source), row * count + k, planes);
}

__kernel void sweep_planes(__global const float *surface, __constant float *cameras, int views, int width,
                           __global const int *places, int first, int count, int number, float nearest, float farthest,
                           __global float *planes)
{
    EACH(k, count)
    const int i = places[first + k];
    const float3 plane = vload3(i, surface);
    const float pixels = pixels_per_inverse(cameras, views, i % width, i / width, plane.x);
    for (int j = 0; j < number; ++j) {
        const int move = j / 2 + 1;
        const float inverse = plane.x + (j % 2 ? -move : move) / fmax(pixels, 1e-12f);
        const bool possible = pixels > 0.0f && inverse > farthest && inverse < nearest;
        vstore3((float3)(possible ? inverse : 0.0f, plane.yz), j * count + k, planes);
    }
}

__kernel void shift_planes(__global const float *surface, __constant float *cameras, int views, int width,
                           __global const int *places, int first, int count, int number, __global float *planes,
                           __global float *same)                   // [places] SAME as inverse depth
{
    EACH(k, count)
    const int i = places[first + k];
    const float3 plane = vload3(i, surface);
    const float pixels = pixels_per_inverse(cameras, views, i % width, i / width, plane.x);
    same[first + k] = SAME / fmax(pixels, 1e-12f);
    for (int j = 0; j < number; ++j) {
        const float inverse = plane.x + SHIFT * (j - number / 2) / fmax(pixels, 1e-12f);
        vstore3((float3)(pixels > 0.0f ? inverse : 0.0f, plane.yz), j * count + k, planes);
    }
}

// Of places of one colour of a chessboard at a time: the pixels around have the other one.
__kernel void spread_planes(__global const float *surface, int width, int height, __global const int *places, int first,
                            int count, __global float *planes)                 // [AROUND, count, 3]
{
    EACH(k, count)
    const int2 at = (int2)(places[first + k] % width, places[first + k] / width);
    for (int j = 0; j < AROUND; ++j) {
        const int2 near = at + NEIGHBOUR[j];
        float3 plane = (float3)(0.0f);
        if (all(near >= 0) && near.x < width && near.y < height) {
            plane = vload3(near.y * width + near.x, surface);
            plane.x = extended(plane, j);
        }
        vstore3(plane, j * count + k, planes);
    }
}

// Work-items (place, COLUMNS hypotheses).
__kernel void score_planes(__global const float *planes, __constant float *cameras, int view,
                           __global const uchar4 *target_photo, __global const uchar4 *photo,
                           __global const int *places, int first, int count, int number,
                           float contrast,         // difference of grey at which a pixel of the patch counts half
                           float noise,            // variance of the photo's noise
                           __global const float *depth, __global const float *surface,
                           __global const float *same,             // how far off its plane a pixel counts; null: any
                           __global float *costs)                              // [views, number, count]
{
    const Camera target = load_camera(cameras, 0), context = load_camera(cameras, view);
    const int k = get_global_id(0), start = get_global_id(1) * COLUMNS;
    if (k >= count || start >= number)
        return;
    const int2 at = (int2)(places[first + k] % target.width, places[first + k] / target.width);
    const float middle = grey_of(target_photo[at.y * target.width + at.x]);
    columns_t here_inverse = ZERO, along_x = ZERO, along_y = ZERO;
    for (int lane = 0; lane < COLUMNS && start + lane < number; ++lane) {
        const float3 plane = vload3((start + lane) * count + k, planes);
        SET_LANE(here_inverse, lane, plane.x);
        SET_LANE(along_x, lane, plane.y);
        SET_LANE(along_y, lane, plane.z);
    }
    const mask_t possible = here_inverse > 0.0f;
    const float3 initial = same ? vload3(places[first + k], surface) : (float3)(0.0f);
    columns_t n = ZERO, sum = ZERO, a = ZERO, b = ZERO, aa = ZERO, bb = ZERO, ab = ZERO;
    if (ANY(possible))
        for (int y = -HALF; y <= HALF; ++y)
            for (int x = -HALF + ((y + HALF) & 1); x <= HALF; x += 2) {
                const int2 p = at + (int2)(x, y);
                if (any(p < 0) || p.x >= target.width || p.y >= target.height)
                    continue;
                const int i = p.y * target.width + p.x;
                const uchar4 own = target_photo[i];
                if (own.w == 0)
                    continue;
                if (same && !(fabs(1.0f / depth[i] - initial.x - x * initial.y - y * initial.z) < same[first + k]))
                    continue;
                const float3 q = turned_ray(target, context, p.x, p.y);
                const columns_t inverse = here_inverse + x * along_x + y * along_y;
                const columns_t z = q.z + inverse * context.t.z, over = 1.0f / z;
                const columns_t mean_x = context.fx * (q.x + inverse * context.t.x) * over + context.cx;
                const columns_t mean_y = context.fy * (q.y + inverse * context.t.y) * over + context.cy;
                const mask_t ahead = possible & (inverse > 0.0f) & (z > NEAR * inverse);
                columns_t there = (columns_t)(-1.0f);
                for (int lane = 0; lane < COLUMNS; ++lane) {
                    float3 color;
                    const float2 mean = (float2)(LANE(float, mean_x, lane), LANE(float, mean_y, lane));
                    if (LANE(int, ahead, lane) && look_up(photo, context, mean, &color))
                        SET_LANE(there, lane, LUMA(color.x, color.y, color.z));
                }
                const mask_t seen = there >= 0.0f;
                const float here = grey_of(own), other = (here - middle) / contrast;
                const columns_t weight = select(ZERO, (columns_t)(1.0f / (1.0f + other * other)), seen);
                n += select(ZERO, (columns_t)(1.0f), seen);
                sum += weight;
                a += weight * here;
                b += weight * there;
                aa += weight * here * here;
                bb += weight * there * there;
                ab += weight * here * there;
            }
    const columns_t over = 1.0f / sum;
    const columns_t var_a = aa * over - a * a * over * over, var_b = bb * over - b * b * over * over;
    const columns_t cost = 1.0f - (ab * over - a * b * over * over)
                                  / sqrt((fmax(var_b, ZERO) + noise) * (var_a + noise));
    const mask_t shown = (n >= (same ? (float)LEAST_SAME : (float)LEAST_SAMPLES)) & (var_a > 4.0f * noise);
    const columns_t defined = select((columns_t)(UNDEFINED), cost, shown);
    for (int lane = 0; lane < COLUMNS && start + lane < number; ++lane)
        costs[((view - 1) * number + start + lane) * count + k] = LANE(float, defined, lane);
}

__kernel void choose_planes(__global const float *planes, __global const float *costs, int views,
                            __global const int *places, int first, int count, int number,
                            __global float *surface, __global float *cost)     // [H, W, 3]; [places]
{
    EACH(k, count)
    float least = cost[first + k];
    int best = -1;
    for (int j = 0; j < number; ++j) {
        const float here = better_half(costs + j * count + k, views, number * count);
        if (here < least) {
            least = here;
            best = j;
        }
    }
    if (best < 0)
        return;
    cost[first + k] = least;
    vstore3(vload3(best * count + k, planes), places[first + k], surface);
}

// Hypothesis 0 is the initial plane, 1 the one that was found.
__kernel void accept_planes(__global const float *planes, __global const float *costs, __constant float *cameras,
                            int views, int width, __global const int *places, int first, int count,
                            __global uchar *accepted)                          // [H, W]
{
    EACH(k, count)
    const int i = places[first + k];
    const float found = planes[3 * (count + k)], moved = fabs(found - planes[3 * k]);
    float gained = 0.0f;
    int better = 0;
    for (int view = 0; view < views; ++view) {
        const float old = costs[2 * view * count + k], new = costs[(2 * view + 1) * count + k];
        gained += fmin(old, 1.0f) - fmin(new, 1.0f);
        better += new < MATCHES && new < old - BETTER;
    }
    accepted[i] = better >= clamp(views - 1, 2, 3) && gained > GAINED * views
                  && moved * pixels_per_inverse(cameras, views, i % width, i / width, found) > WITHIN_REACH;
}

__kernel void keep_supported(__global const float *surface, __global const uchar *accepted, __constant float *cameras,
                             int views, int width, int height, __global const int *places, int count,
                             __global float *found)                // [count] 0 = the initial depth stays
{
    EACH(k, count)
    const int i = places[k], column = i % width, row = i / width;
    found[k] = 0.0f;
    if (!accepted[i])
        return;
    const float3 plane = vload3(i, surface);
    const float within = 1.0f / fmax(pixels_per_inverse(cameras, views, column, row, plane.x), 1e-12f);
    int support = 0;
    EACH_AROUND(x, y, column, row, 2, width, height) {
        const float3 near = vload3(y * width + x, surface);
        const float expected = plane.x + (x - column) * plane.y + (y - row) * plane.z;
        support += near.x > 0.0f && fabs(near.x - expected) < within;
    }
    if (support > SUPPORT)       // itself among them
        found[k] = 1.0f / plane.x;
}
