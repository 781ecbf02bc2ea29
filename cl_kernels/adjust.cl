// Cameras from all pixels of all photos, one free depth a pixel (method section 9). Lengths in units.
//
// A row is what a pixel says of one context view, each number times the root of its weight:
//   s0 to s5     derivatives by the context camera's twist, turning first (the target's follows from it)
//   s6, s7       residual; derivative by the depth
//   s8 to sd     with INTRINSICS: by the logarithm of the focal length and by the principal point (x, y) of the context
//                camera, then of the target's
//   se, sf       with INTRINSICS: by a scale and a shift of the target's depth map
#define CAMERA_SPACE __global const      // all views of a scene at once, more than constant memory may hold
#include "camera.clh"

#ifdef INTRINSICS
typedef float16 row_t;
#define ROW 16
#define COLUMNS_OF_ROW 14
#else
typedef float8 row_t;
#define ROW 8
#define COLUMNS_OF_ROW 6
#endif

// Weights of Catmull and Rom's cubic and their derivatives, at t from 0 to 1 between the middle two of four.
void cubic(float t, float w[4], float dw[4])
{
    w[0] = t * (-0.5f + t * (1.0f - 0.5f * t));
    w[1] = 1.0f + t * t * (1.5f * t - 2.5f);
    w[2] = t * (0.5f + t * (2.0f - 1.5f * t));
    w[3] = t * t * (0.5f * t - 0.5f);
    dw[0] = -0.5f + t * (2.0f - 1.5f * t);
    dw[1] = t * (4.5f * t - 5.0f);
    dw[2] = 0.5f + t * (4.0f - 4.5f * t);
    dw[3] = t * (1.5f * t - 1.0f);
}

// Value and gradient of an image at a mean that lies inside by the border.
float3 looked_up(__global const float *image, int width, float x, float y)
{
    const int left = (int)(x - 0.5f), top = (int)(y - 0.5f);
    float wx[4], dx[4], wy[4], dy[4];
    cubic(x - 0.5f - left, wx, dx);
    cubic(y - 0.5f - top, wy, dy);
    float3 sum = 0.0f;
    for (int v = 0; v < 4; ++v) {
        __global const float *row = image + (top - 1 + v) * width + left - 1;
        const float value = wx[0] * row[0] + wx[1] * row[1] + wx[2] * row[2] + wx[3] * row[3];
        const float slope = dx[0] * row[0] + dx[1] * row[1] + dx[2] * row[2] + dx[3] * row[3];
        sum += (float3)(wy[v] * value, wy[v] * slope, dy[v] * value);
    }
    return sum;
}

typedef struct {
    bool seen;
    float residual;
    float2 gradient;          // of the context photo
    float3 ray, turned, point;       // rho, R rho, d R rho + tau
} Sight;

bool within(const Camera camera, float x, float y)
{
    return x >= BORDER && y >= BORDER && x <= camera.width - BORDER && y <= camera.height - BORDER;
}

Sight sight_of(__global const float *normal, __global const float *depth, CAMERA_SPACE float *cameras, int view,
               __global const float *other_normal, __global const float *other_depth, int column, int row,
               float tolerance)
{
    const Camera target = load_camera(cameras, 0), other = load_camera(cameras, view);
    Sight sight;
    sight.seen = false;
    const int i = row * target.width + column;
    const float d = depth[i];
    if (!(d > 0.0f) || !within(target, column + 0.5f, row + 0.5f))
        return sight;
    sight.ray = pixel_ray(target, column, row);
    sight.turned = (float3)(dot(other.r0, sight.ray), dot(other.r1, sight.ray), dot(other.r2, sight.ray));
    sight.point = d * sight.turned + other.t;
    if (!(sight.point.z > NEAR))
        return sight;
    const float x = other.fx * sight.point.x / sight.point.z + other.cx;
    const float y = other.fy * sight.point.y / sight.point.z + other.cy;
    if (!within(other, x, y))
        return sight;
    const float own = other_depth[(int)y * other.width + (int)x];
    if (!(fabs(own - sight.point.z) <= tolerance * sight.point.z) || !(own > 0.0f))
        return sight;
    const float3 value = looked_up(other_normal, other.width, x, y);
    sight.residual = value.x - normal[i];
    sight.gradient = value.yz;
    sight.seen = isfinite(sight.residual);
    return sight;
}

// Huber's weight, and none for what shows something else.
float weight_of(float residual)
{
    const float size = fabs(residual);
    return size > CUT ? 0.0f : size > HUBER ? HUBER / size : 1.0f;
}

// The rows of a target in one context photo.
__kernel void linearize(__global const float *normal, __global const float *depth, CAMERA_SPACE float *cameras,
                        int view, __global const float *other_normal, __global const float *other_depth,
                        float tolerance, int width, int height, __global row_t *rows)       // [views, H, W]
{
    EACH_PIXEL(column, row, i, width, height)
    const Sight s = sight_of(normal, depth, cameras, view, other_normal, other_depth, column, row, tolerance);
    const int at = (view - 1) * width * height + i;
    const float weight = s.seen ? sqrt(weight_of(s.residual)) : 0.0f;
    if (!(weight > 0.0f)) {
        rows[at] = 0.0f;
        return;
    }
    const Camera other = load_camera(cameras, view);
    const float inverse_z = 1.0f / s.point.z;
    const float2 g = weight * s.gradient, across = s.point.xy * inverse_z;
    const float3 J = inverse_z * (float3)(other.fx * g.x, other.fy * g.y,
                                          -(other.fx * g.x * across.x + other.fy * g.y * across.y));
    const float3 turn = cross(s.point, J);
    const float by_depth = dot(g, dmean_ddepth(other, s.turned)) * inverse_z * inverse_z;
#ifdef INTRINSICS
    const Camera target = load_camera(cameras, 0);
    const float3 own = depth[i] * (float3)(dot((float3)(other.r0.x, other.r1.x, other.r2.x), J),
                                           dot((float3)(other.r0.y, other.r1.y, other.r2.y), J), 0.0f);
    rows[at] = (row_t)(turn, J, weight * s.residual, by_depth,
                       g.x * other.fx * across.x + g.y * other.fy * across.y, g.x, g.y,
                       -dot(own.xy, s.ray.xy), -own.x * target.ifx, -own.y * target.ify, depth[i] * by_depth, by_depth);
#else
    rows[at] = (row_t)(turn, J, weight * s.residual, by_depth);
#endif
}

// Numerator and denominator of the step of each depth while the cameras stay; `prior` holds what no photo fixes, and is
// infinite where depths are to stay.
__kernel void eliminate(__global const row_t *rows, __global const float *depth, int views, float prior, int width,
                        int height, __global float2 *steps)
{
    EACH_PIXEL(x, y, i, width, height)
    float2 sum = (float2)(0.0f, prior);
    for (int view = 0; view < views; ++view) {
        const row_t row = rows[view * width * height + i];
        sum += row.s7 * (float2)(-row.s6, row.s7);
    }
    steps[i] = depth[i] > 0.0f ? sum : 0.0f;
}

// One row of a block of the normal equations, of two context views: sum over CHUNK pixels of
// (same view - c c' / h) a a', with a the derivatives and c that by depth. Where both views are the same, place 6 gets
// the sum of a times the residual after the depth's own step; place 7 of the first row the number of pixels used,
// of the second the sum of their squared residuals.
__kernel void sum_pairs(__global const row_t *rows, __global const float2 *steps, int views, int count, int chunks,
                        __global row_t *partial)             // [chunks, pairs, COLUMNS_OF_ROW]
{
    const int entry = get_global_id(0), chunk = get_global_id(1);
    const int pairs = views * (views + 1) / 2;
    if (entry >= pairs * COLUMNS_OF_ROW || chunk >= chunks)
        return;
    const int column = entry % COLUMNS_OF_ROW, lane = column < 6 ? column : column + 2;
    int first = 0, second = entry / COLUMNS_OF_ROW;
    for (; second >= views - first; ++first)
        second -= views - first;
    second += first;
    __global const row_t *one = rows + first * count, *two = rows + second * count;
    const bool same = first == second;
    row_t sum = 0.0f;
    float right = 0.0f, judged = 0.0f;
    const int end = min((chunk + 1) * CHUNK, count);
    for (int p = chunk * CHUNK; p < end; ++p) {
        const float a = ((__global const float *)(one + p))[lane];
        const float c = one[p].s7;
        const float2 step = steps[p];
        const float inverse = step.y > 0.0f ? 1.0f / step.y : 0.0f;
        const row_t other = two[p];
        sum += a * ((same ? 1.0f : 0.0f) - c * other.s7 * inverse) * other;
        const float left = other.s6 + other.s7 * step.x * inverse;
        right += a * left;
        judged += column == 0 ? (other.s3 != 0.0f || other.s4 != 0.0f ? 1.0f : 0.0f) : left * left;
    }
    sum.s6 = same ? right : 0.0f;
    sum.s7 = same && column < 2 ? judged : 0.0f;
    partial[chunk * pairs * COLUMNS_OF_ROW + entry] = sum;
}

// Sums over the chunks, what rounding drops next to them.
__kernel void sum_chunks(__global const float *partial, int entries, int chunks, __global float2 *sums)
{
    EACH(k, entries)
    float sum = 0.0f, rest = 0.0f;
    for (int chunk = 0; chunk < chunks; ++chunk) {
        const float value = partial[chunk * entries + k], next = sum + value, back = next - sum;
        rest += (sum - (next - back)) + (value - back);
        sum = next;
    }
    sums[k] = (float2)(sum, rest);
}

// Robust cost of the residuals of chunks of pixels, and how many there are.
__kernel void pair_cost(__global const float *normal, __global const float *depth, CAMERA_SPACE float *cameras,
                        int view, __global const float *other_normal, __global const float *other_depth,
                        float tolerance, int width, int count, int chunks, __global float2 *costs)
{
    EACH(chunk, chunks)
    float2 sum = 0.0f;
    for (int i = chunk * COST_CHUNK; i < min((chunk + 1) * COST_CHUNK, count); ++i) {
        const Sight s = sight_of(normal, depth, cameras, view, other_normal, other_depth, i % width, i / width,
                                 tolerance);
        if (s.seen) {
            const float size = fmin(fabs(s.residual), CUT);
            sum += (float2)(size > HUBER ? HUBER * (size - 0.5f * HUBER) : 0.5f * size * size, 1.0f);
        }
    }
    costs[chunk] = sum;
}

// `limit`: the most that a depth of 1 moves by; parallax goes with the square of the depth.
__kernel void move_depth(__global const float2 *steps, float limit, int width, int height, __global float *depth)
{
    EACH_PIXEL(x, y, i, width, height)
    const float d = depth[i], most = fmin(limit * d * d, 0.5f * d);
    if (d > 0.0f && steps[i].y > 0.0f)
        depth[i] = d + clamp(steps[i].x / steps[i].y, -most, most);
}

// Depths at a finer size: the initial ones there times what the coarse ones were multiplied by.
__kernel void carry_depth(__global const float *coarse, __global const float *coarse_initial, int source_width,
                          int source_height, int width, int height, __global float *depth)
{
    EACH_PIXEL(x, y, i, width, height)
    const float u = (x + 0.5f) * source_width / width - 0.5f, v = (y + 0.5f) * source_height / height - 0.5f;
    const int left = (int)floor(u), top = (int)floor(v);
    float2 sum = 0.0f;
    for (int dy = 0; dy <= 1; ++dy)
        for (int dx = 0; dx <= 1; ++dx) {
            const int at = clamp(top + dy, 0, source_height - 1) * source_width + clamp(left + dx, 0, source_width - 1);
            const float w = (dx ? u - left : 1.0f - (u - left)) * (dy ? v - top : 1.0f - (v - top));
            if (coarse_initial[at] > 0.0f)
                sum += w * (float2)(coarse[at] / coarse_initial[at], 1.0f);
        }
    depth[i] *= sum.y > 1e-6f ? sum.x / sum.y : 1.0f;
}

__kernel void rescale_depth(float scale, float shift, int width, int height, __global float *depth)
{
    EACH_PIXEL(x, y, i, width, height)
    depth[i] = depth[i] > 0.0f ? fmax(scale * depth[i] + shift, 0.0f) : 0.0f;
}
