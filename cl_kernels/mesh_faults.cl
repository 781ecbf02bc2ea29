// What is wrong with a mesh's triangles (method section 10.5): those that cross others, that turned over, that have no
// area; and displacements by which they go. Lengths in units of the mesh's size, places relative to its middle.
// Triangles come in an order in which neighbours in space are neighbours; boxes around BRANCHES of them, around BRANCHES
// of those, and so on, are a tree, whose cost does not depend on how long or how close together triangles are. Boxes
// whose triangles all share a corner are around the other corners: all boxes around a hub would hold it.
//
//   positions, before    [V, 3] where the vertices are, and were before they moved
//   faces, count         [F, 3], and F
//   found                [F] what is wrong with each: TURNED or FLAT, CROSSING, FOLDED
//   moved                [V] whether a vertex has moved since `found` was found
//   again                whether it was; then only what has moved, or crossed, looks at the others, else each does
//   part                 [V] connected part of the mesh
//   boxes                [F and more, 2, 3] low, high; `first`: where those of each level of the tree begin
//   hubs                 [boxes above the triangles' own] the corner that all triangles in it share, or -1
#include "constants.clh"

#define CODE_BITS 20                     // of each coordinate: as fine as places are
#define BRANCH_BITS 3
#define BRANCHES (1 << BRANCH_BITS)
#define NO_AREA 1e-4f                    // height over longest edge
#define MANY 2                           // level of boxes that hold enough to look at more than their coordinates
#define ROUNDING 1e-6f                   // of products of a side and a way within 1, of the side
#define UNSURE 1e-5f                     // share of two lengths by which signs of volumes of them may be wrong
#define TOUCH 1e-3f                      // share of an edge that must be beyond where triangles cross; less is touching
#define TURNED 1
#define FLAT 2
#define CROSSING 4                       // a triangle of another part
#define FOLDED 8                         // of its own

typedef struct {
    int3 corner;
    float3 a, b, c, low, high;
} Triangle;

Triangle triangle_at(__global const float *positions, __global const int *faces, int i)
{
    Triangle t;
    t.corner = vload3(i, faces);
    t.a = vload3(t.corner.x, positions);
    t.b = vload3(t.corner.y, positions);
    t.c = vload3(t.corner.z, positions);
    t.low = fmin(t.a, fmin(t.b, t.c));
    t.high = fmax(t.a, fmax(t.b, t.c));
    return t;
}

// The bits of the three coordinates of a place in turn, the highest first.
ulong code_of(float3 place)
{
    const uint3 whole = convert_uint3_sat(clamp(place + 0.5f, 0.0f, 1.0f) * ((1 << CODE_BITS) - 1));
    ulong code = 0;
    for (int bit = CODE_BITS - 1; bit >= 0; --bit) {
        const uint3 next = whole >> (uint)bit & 1u;
        code = code << 3 | next.x << 2 | next.y << 1 | next.z;
    }
    return code;
}

__kernel void find_codes(__global const float *before, __global const int *faces, int count, __global ulong *codes)
{
    EACH(i, count)
    const Triangle t = triangle_at(before, faces, i);
    codes[i] = code_of(0.5f * (t.low + t.high));
}

// whether the edge from p to q goes through the triangle a, b, c
bool pierces(float3 p, float3 q, float3 a, float3 b, float3 c)
{
    const float3 n = cross(b - a, c - a), along = q - p;
    const float start = dot(n, p - a), end = dot(n, q - a), least = TOUCH * length(n) * length(along);
    if (!(fmin(start, end) < -least && fmax(start, end) > least))
        return false;
    const float3 to_a = a - p, to_b = b - p, to_c = c - p;
    const float u = dot(along, cross(to_c, to_b)), v = dot(along, cross(to_a, to_c)), w = dot(along, cross(to_b, to_a));
    return (u >= 0.0f && v >= 0.0f && w >= 0.0f) || (u <= 0.0f && v <= 0.0f && w <= 0.0f);
}

// whether a side of s goes through t; none does where s lies on one side of t's plane
bool either(const Triangle *s, const Triangle *t)
{
    const float3 n = cross(t->b - t->a, t->c - t->a);
    const float a = dot(n, s->a - t->a), b = dot(n, s->b - t->a), c = dot(n, s->c - t->a);
    if (fmin(a, fmin(b, c)) >= 0.0f || fmax(a, fmax(b, c)) <= 0.0f)
        return false;
    return pierces(s->a, s->b, t->a, t->b, t->c) || pierces(s->b, s->c, t->a, t->b, t->c)
        || pierces(s->c, s->a, t->a, t->b, t->c);
}

// Triangles that share a side do not cross; sides that end in a corner of the other triangle do not go through it.
bool cross_each_other(const Triangle *s, const Triangle *t)
{
    const int shared = any(s->corner.x == t->corner) + any(s->corner.y == t->corner) + any(s->corner.z == t->corner);
    return shared > 1 ? shared == 3 : either(s, t) || either(t, s);
}

// The boxes around the triangles, what is wrong with each by itself, and which look at others.
__kernel void find_boxes(__global const float *positions, __global const float *before, __global const int *faces,
                         int count, __global const uchar *moved, int again, __global float *boxes, __global int *found,
                         __global uchar *active)
{
    EACH(k, count)
    const Triangle t = triangle_at(positions, faces, k);
    vstore3(t.low, 2 * k, boxes);
    vstore3(t.high, 2 * k + 1, boxes);
    active[k] = !again || (found[k] & (CROSSING | FOLDED)) || moved[t.corner.x] || moved[t.corner.y]
        || moved[t.corner.z];
    const float3 ab = t.b - t.a, ac = t.c - t.a, bc = t.c - t.b, now = cross(ab, ac);
    const float3 start = vload3(t.corner.x, before);
    const float3 then = cross(vload3(t.corner.y, before) - start, vload3(t.corner.z, before) - start);
    const float longest = fmax(dot(ab, ab), fmax(dot(ac, ac), dot(bc, bc)));
    found[k] = !(length(now) > NO_AREA * longest) ? FLAT : dot(now, then) < 0.0f ? TURNED : 0;
}

void widen_box(float3 *low, float3 *high, float3 from, float3 to)
{
    *low = fmin(*low, from);
    *high = fmax(*high, to);
}

// `level` of the tree, whose boxes, and those of the level below, begin where `first` says
__kernel void join_boxes(__global const float *positions, __global const int *faces, __global const int *first,
                         int level, int count, __global float *boxes, __global int *hubs)
{
    EACH(k, count)
    const int begin = first[level - 1] + k * BRANCHES, end = min(begin + BRANCHES, first[level]), box = first[level] + k;
    __global const int *below = hubs - first[1];
    int hub;
    if (level == 1) {
        int3 shared = vload3(begin, faces);
        for (int j = begin + 1; j < end; ++j) {
            const int3 corner = vload3(j, faces);
            shared.x = any(shared.x == corner) ? shared.x : -1;
            shared.y = any(shared.y == corner) ? shared.y : -1;
            shared.z = any(shared.z == corner) ? shared.z : -1;
        }
        hub = max(shared.x, max(shared.y, shared.z));
    } else {
        hub = below[begin];
        for (int j = begin + 1; j < end; ++j)
            hub = below[j] == hub ? hub : -1;
    }
    float3 low = INFINITY, high = -INFINITY;
    for (int j = begin; j < end; ++j) {
        if (level == 1 && hub >= 0) {
            for (int c = 0; c < 3; ++c) {
                const float3 place = vload3(faces[3 * j + c], positions);
                if (faces[3 * j + c] != hub)
                    widen_box(&low, &high, place, place);
            }
            continue;
        }
        widen_box(&low, &high, vload3(2 * j, boxes), vload3(2 * j + 1, boxes));
        if (level > 1 && below[j] != hub) {
            const float3 place = vload3(below[j], positions);
            widen_box(&low, &high, place, place);
        }
    }
    vstore3(low, 2 * box, boxes);
    vstore3(high, 2 * box + 1, boxes);
    hubs[box - first[1]] = hub;
}

// Whether a box is off a triangle a, a + side, a + other: on one side of its plane, or apart from it when both are
// seen along an axis and turned so that `side` points away. Most of a mesh may be in the box around a long triangle.
bool off_triangle(float3 a, float3 side, float3 other, float3 low, float3 high)
{
    const float3 n = cross(side, other), half_size = 0.5f * (high - low), middle = low + half_size - a;
    const float3 across = cross(side, middle), along = fabs(side), slack = ROUNDING * length(side);
    const float3 reach = along.yzx * half_size.zxy + along.zxy * half_size.yzx + slack;
    return any(across - reach > fmax(n, 0.0f)) || any(across + reach < fmin(n, 0.0f))
        || fabs(dot(n, middle)) > dot(fabs(n), half_size) + slack.x * length(other);
}

// Whether a box is beyond one of the two sides of a triangle that meet in its corner `hub`, at `place`: then all triangles
// between that corner and what is in the box are off it.
bool beyond_sides(const Triangle *t, int hub, float3 place, float3 low, float3 high)
{
    const float3 to_a = t->a - place, to_b = t->b - place, to_c = t->c - place;
    const float3 one = hub == t->corner.x ? to_b : hub == t->corner.y ? to_c : to_a;
    const float3 other = hub == t->corner.x ? to_c : hub == t->corner.y ? to_a : to_b;
    const float3 n = cross(one, other), inward = cross(n, one), back = cross(other, n);
    const float3 half_size = 0.5f * (high - low), middle = low + half_size - place;
    const float unsure = UNSURE * (length(one) + length(other) + length(middle) + length(half_size));
    return (dot(inward, other) > 0.0f
            && dot(inward, middle) + dot(fabs(inward), half_size) < -unsure * length(inward))
        || (dot(back, one) > 0.0f && dot(back, middle) + dot(fabs(back), half_size) < -unsure * length(back));
}

// Each active triangle looks at those that come after it, and at those before it that do not look themselves.
__kernel void find_crossing(__global const float *positions, __global const int *faces, int count, int again,
                            __global const uchar *active, __global const int *first, __global const float *boxes,
                            __global const int *hubs, __global const int *part, __global int *found)
{
    EACH(i, count)
    if (!active[i])
        return;
    const Triangle own = triangle_at(positions, faces, i);
    if (all(own.low == own.high))
        return;
    const float3 ab = own.b - own.a, ac = own.c - own.a;
    const bool first_longer = dot(ab, ab) > dot(ac, ac);
    const float3 side = first_longer ? ab : ac, other = first_longer ? ac : ab;
    int crosses = 0;
    for (int k = again ? 0 : i + 1, level = 0; k << level * BRANCH_BITS < count;) {
        const int box = first[level] + k;
        float3 low = vload3(2 * box, boxes), high = vload3(2 * box + 1, boxes);
        const int hub = level ? hubs[box - first[1]] : -1;
        bool apart = false;
        if (hub >= 0) {
            const float3 place = vload3(hub, positions);
            apart = any(hub == own.corner) && beyond_sides(&own, hub, place, low, high);
            widen_box(&low, &high, place, place);
        }
        apart = apart || any(low > own.high) || any(high < own.low)
            || (level >= MANY && off_triangle(own.a, side, other, low, high));
        if (!apart && level > 0) {
            k *= BRANCHES;
            --level;
            continue;
        }
        if (!apart && (k > i || (k < i && !active[k]))) {
            const int fault = part[own.corner.x] == part[faces[3 * k]] ? FOLDED : CROSSING;
            const bool known = (crosses & fault) && (atomic_or(&found[k], 0) & fault);
            const Triangle that = triangle_at(positions, faces, k);
            if (!known && cross_each_other(&own, &that)) {
                crosses |= fault;
                atomic_or(&found[k], fault);
            }
        }
        for (++k; k % BRANCHES == 0; k /= BRANCHES)
            ++level;
    }
    if (crosses)
        atomic_or(&found[i], crosses);
}

// Corners of the faces that have a fault that is not tolerated, and how many faces these are.
__kernel void mark(__global const int *faces, __global const int *found, __global const int *tolerated, int count,
                   __global uchar *marked, __global int *number)       // [V]; [1]
{
    EACH(i, count)
    if (!(found[i] & ~tolerated[i]))
        return;
    const int3 corner = vload3(i, faces);
    marked[corner.x] = marked[corner.y] = marked[corner.z] = 1;
    atomic_inc(number);
}

// Corners of the faces that have one that is marked: wider, which begins as a copy of what is marked.
__kernel void widen(__global const int *faces, int count, __global const uchar *marked, __global uchar *wider)   // [V]
{
    EACH(i, count)
    const int3 corner = vload3(i, faces);
    if (marked[corner.x] || marked[corner.y] || marked[corner.z])
        wider[corner.x] = wider[corner.y] = wider[corner.z] = 1;
}

// Vertices that are marked, displaced by half as much or as the mean of their neighbours is.
__kernel void displace(__global const float *positions, __global const float *before, __global const int *first,
                       __global const int2 *pairs, __global const uchar *marked, int count, int halved,
                       __global float *after, __global uchar *moved)       // [V, 3], [V]
{
    EACH(i, count)
    float3 place = vload3(i, positions);
    if (marked[i]) {
        const float3 start = vload3(i, before);
        float3 sum = 0.0f;
        for (int k = first[i]; k < first[i + 1] && !halved; ++k)
            sum += (vload3(pairs[k].x, positions) - vload3(pairs[k].x, before))
                   + (vload3(pairs[k].y, positions) - vload3(pairs[k].y, before));
        place = start + (halved ? 0.5f * (place - start) : sum / (2.0f * (first[i + 1] - first[i])));
        moved[i] = 1;
    }
    vstore3(place, i, after);
}
