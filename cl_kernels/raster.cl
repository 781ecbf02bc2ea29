// Depth of a triangle mesh in a camera: a z-buffer without clipping (method section 10.1).
// Depths are positive, so that their bits sort as the numbers do: one atomic minimum a pixel, in any order. What
// decides whether a pixel's centre lies in a triangle is written with fma() alone, so that no compiler contracts it
// one way for one triangle and another way for its neighbour: no pixel falls between two triangles.
#include "constants.clh"
#include "eye.clh"
#include "lanes.clh"

#define LARGE 256                        // pixels of the bounding box from which on a work-group draws, by blocks
#define BLOCK_WIDTH (8 * COLUMNS)
#define BLOCK_HEIGHT 8
#define ROUNDING 1e-5f                   // of products of places, of their size: more than it can be
#define NEAR_SHARE 1e-6f                 // of a triangle's largest depth: nearer to the camera's plane it is left out
#define EMPTY 0x7f800000u                // infinity: no surface

float fixed_dot(float3 a, float3 b)
{
    return fma(a.x, b.x, fma(a.y, b.y, a.z * b.z));
}

// A vertex in the camera's frame. Vertices and centre come as two floats each, whose difference loses no digits.
float3 seen_from(const Eye eye, __global const float *vertices, int vertex)
{
    const float3 a = vload3(2 * vertex, vertices), b = -eye.center;
    const float3 sum = a + b, back = sum - a, rest = (a - (sum - back)) + (b - back);
    const float3 d = sum + (rest + (vload3(2 * vertex + 1, vertices) - eye.center_rest));
    return (float3)(fixed_dot(eye.r0, d), fixed_dot(eye.r1, d), fixed_dot(eye.r2, d));
}

float2 pixel_of(const Eye eye, float3 p)
{
    return (float2)(eye.fx * (p.x / p.z) + eye.cx, eye.fy * (p.y / p.z) + eye.cy);
}

__kernel void look(__global const float *vertices,                 // [V, 2, 3] units: rounded, and what is left
                   int count, __constant float *camera, __global float *seen)       // [V, 5] units, pixels
{
    EACH(i, count)
    const Eye eye = load_eye(camera);
    const float3 p = seen_from(eye, vertices, i);
    const float2 pixel = pixel_of(eye, p);
    vstore3(p, 0, seen + 5 * i);
    seen[5 * i + 3] = pixel.x;
    seen[5 * i + 4] = pixel.y;
}

typedef struct {
    float3 a, b, c;
    int4 box;                            // first and last column, first and last row
} Triangle;

void extend(float2 pixel, float4 *box)
{
    *box = (float4)(fmin(box->x, pixel.x), fmax(box->y, pixel.x), fmin(box->z, pixel.y), fmax(box->w, pixel.y));
}

void extend_to_plane(const Eye eye, float3 p, float3 q, float near, float4 *box)
{
    if ((p.z >= near) == (q.z >= near))
        return;
    const float share = (near - p.z) / (q.z - p.z);
    extend(pixel_of(eye, (float3)(p.x + share * (q.x - p.x), p.y + share * (q.y - p.y), near)), box);
}

// Corners, and the pixels whose centres the part in front of the camera may hold; false where there are none.
bool load_triangle(const Eye eye, __global const float *seen, __global const int *faces, int face, Triangle *t)
{
    const int3 corner = vload3(face, faces);
    __global const float *a = seen + 5 * corner.x, *b = seen + 5 * corner.y, *c = seen + 5 * corner.z;
    t->a = vload3(0, a);
    t->b = vload3(0, b);
    t->c = vload3(0, c);
    const float near = NEAR_SHARE * fmax(t->a.z, fmax(t->b.z, t->c.z));
    if (!(near > 0.0f))
        return false;
    float4 box = (float4)(INFINITY, -INFINITY, INFINITY, -INFINITY);
    if (t->a.z >= near)
        extend((float2)(a[3], a[4]), &box);
    if (t->b.z >= near)
        extend((float2)(b[3], b[4]), &box);
    if (t->c.z >= near)
        extend((float2)(c[3], c[4]), &box);
    extend_to_plane(eye, t->a, t->b, near, &box);
    extend_to_plane(eye, t->b, t->c, near, &box);
    extend_to_plane(eye, t->c, t->a, near, &box);
    const float4 wide = 0.01f + 1e-5f * fabs(box);                   // more than rounding can move a pixel's centre
    t->box = (int4)((int)ceil(clamp(box.x - wide.x - 0.5f, 0.0f, (float)eye.width)),
                    (int)floor(clamp(box.y + wide.y - 0.5f, -1.0f, eye.width - 1.0f)),
                    (int)ceil(clamp(box.z - wide.z - 0.5f, 0.0f, (float)eye.height)),
                    (int)floor(clamp(box.w + wide.w - 0.5f, -1.0f, eye.height - 1.0f)));
    return t->box.x <= t->box.y && t->box.z <= t->box.w;
}

// a.x b.y - a.y b.x, good to two units in the last place: its sign is right, and the opposite one for (b, a).
columns_t cross_2d(columns_t ax, float ay, columns_t bx, float by)
{
    const columns_t product = ay * bx;
    return fma(ax, (columns_t)(by), -product) + fma((columns_t)(-ay), bx, product);
}

// Neighbouring pixels of a row, from `column` on, or before it at the row's end; those whose rays miss stay.
void draw_columns(const Eye eye, const Triangle t, int column, int row, __global volatile uint *z_buffer)
{
    const int start = min(column, eye.width - COLUMNS), place = row * eye.width + start;
    const columns_t x = -(TO_COLUMNS(start + LANE_NUMBERS) + 0.5f - eye.cx) * eye.ifx;
    const float y = -(row + 0.5f - eye.cy) * eye.ify;
    const columns_t ax = fma(x, (columns_t)(t.a.z), (columns_t)(t.a.x));
    const columns_t bx = fma(x, (columns_t)(t.b.z), (columns_t)(t.b.x));
    const columns_t cx = fma(x, (columns_t)(t.c.z), (columns_t)(t.c.x));
    const float ay = fma(y, t.a.z, t.a.y), by = fma(y, t.b.z, t.b.y), cy = fma(y, t.c.z, t.c.y);
    const columns_t u = cross_2d(bx, by, cx, cy), v = cross_2d(cx, cy, ax, ay), w = cross_2d(ax, ay, bx, by);
    const mask_t hit = (fmin(u, fmin(v, w)) >= 0.0f) | (fmax(u, fmax(v, w)) <= 0.0f);
    if (!ANY(hit))
        return;
    const columns_t z = (u * t.a.z + v * t.b.z + w * t.c.z) / (u + v + w);
    const mask_t nearer = hit & (z > 0.0f) & (z < LOAD_COLUMNS((__global const float *)z_buffer + place));
    for (int k = 0; k < COLUMNS; ++k)
        if (LANE(int, nearer, k))
            atomic_min(&z_buffer[place + k], as_uint(LANE(float, z, k)));
}

void draw_box(const Eye eye, const Triangle t, int4 box, __global volatile uint *z_buffer)
{
    for (int row = box.z; row <= box.w; ++row)
        for (int column = box.x; column <= box.y; column += COLUMNS)
            draw_columns(eye, t, column, row, z_buffer);
}

// 1 where a' x b' is above 0 at four rays, -1 where it is below; linear in between, and surely so.
int side_of(float4 x, float4 y, float3 a, float3 b)
{
    const float4 first = (a.x + x * a.z) * (b.y + y * b.z), second = (a.y + y * a.z) * (b.x + x * b.z);
    const float4 slack = ROUNDING * (fabs(first) + fabs(second));
    return all(first - second > slack) - all(second - first > slack);
}

// Whether no ray of a block of pixels hits the triangle: seen from a pixel around it, two of its sides say no.
bool misses(const Eye eye, const Triangle t, int column, int row)
{
    const float4 x = -((float4)(column - 1, column - 1, column + BLOCK_WIDTH, column + BLOCK_WIDTH) + 0.5f - eye.cx)
                     * eye.ifx;
    const float4 y = -((float4)(row - 1, row + BLOCK_HEIGHT, row - 1, row + BLOCK_HEIGHT) + 0.5f - eye.cy) * eye.ify;
    const int u = side_of(x, y, t.b, t.c), v = side_of(x, y, t.c, t.a), w = side_of(x, y, t.a, t.b);
    return min(u, min(v, w)) < 0 && max(u, max(v, w)) > 0;
}

// Small triangles; the rest go into a list, of which each work-group takes one at a time, its pixels side by side.
__kernel void draw(__global const float *seen, __global const int *faces, int count,           // [V, 5], [F, 3]
                   __constant float *camera, __global volatile uint *z_buffer,      // [H, W] bits of depth, units
                   __global volatile uint *large)                  // [1 + F] how many, and which
{
    EACH(face, count)
    const Eye eye = load_eye(camera);
    Triangle t;
    if (!load_triangle(eye, seen, faces, face, &t))
        return;
    if ((t.box.y - t.box.x + 1) * (t.box.w - t.box.z + 1) > LARGE) {
        large[1 + atomic_inc(&large[0])] = face;
        return;
    }
    draw_box(eye, t, t.box, z_buffer);
}

__kernel void draw_large(__global const float *seen, __global const int *faces, __constant float *camera,
                         __global volatile uint *z_buffer, __global const uint *large)
{
    const Eye eye = load_eye(camera);
    for (uint k = get_group_id(0); k < large[0]; k += get_num_groups(0)) {
        Triangle t;
        load_triangle(eye, seen, faces, large[1 + k], &t);
        const int across = (t.box.y - t.box.x) / BLOCK_WIDTH + 1, down = (t.box.w - t.box.z) / BLOCK_HEIGHT + 1;
        for (int i = get_local_id(0); i < across * down; i += get_local_size(0)) {
            const int column = t.box.x + i % across * BLOCK_WIDTH, row = t.box.z + i / across * BLOCK_HEIGHT;
            if (!misses(eye, t, column, row))
                draw_box(eye, t, (int4)(column, min(column + BLOCK_WIDTH - 1, t.box.y),
                                        row, min(row + BLOCK_HEIGHT - 1, t.box.w)), z_buffer);
        }
    }
}

__kernel void to_depth(__global uint *z_buffer, int count, float unit)        // in place; `unit` of what comes out
{
    EACH(i, count)
    z_buffer[i] = z_buffer[i] == EMPTY ? 0u : as_uint(as_float(z_buffer[i]) * unit);
}
