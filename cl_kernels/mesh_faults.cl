// What is wrong with a mesh's triangles (method section 10.5): those that cross others, that turned over, that have no
// area. Lengths in units of the mesh's size, places relative to its middle. Each triangle lies in one cell of a grid
// whose cells are once to twice as wide as it is; grids are hashed into one table of `mask` + 1 places.
//   find_cells     where each triangle lies, and what is wrong with it by itself
//   find_boxes     the boxes around the triangles, in the order of their places
//   find_crossing  pairs that cross: each triangle looks at those of its own size and of every larger one
#include "constants.clh"

#define FINEST -24                       // widths of cells are powers of two, from this one on: as fine as places are
#define COARSEST 1
#define NO_AREA 1e-4f                    // height over longest edge
#define TOUCH 1e-3f                      // share of an edge that must be beyond where triangles cross; less is touching
#define TURNED 1
#define FLAT 2
#define CROSSING 4                       // a triangle of another part
#define FOLDED 8                         // of its own

typedef struct {
    int3 corner;
    float3 a, b, c, low, high;
    int level;
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
    const float3 wide = t.high - t.low;
    const float widest = fmax(wide.x, fmax(wide.y, wide.z));
    t.level = clamp((as_int(widest) >> 23) - 126, FINEST, COARSEST);      // the least power of two that is wider
    return t;
}

// 2^-level, exactly.
float cells(int level)
{
    return as_float((127 - level) << 23);
}

uint place_of(int3 cell, int level)
{
    const uint3 mixed = convert_uint3(cell) * (uint3)(73856093u, 19349663u, 83492791u);
    const uint all = (mixed.x ^ mixed.y ^ mixed.z ^ (uint)(level - FINEST) * 2654435761u) * 2246822519u;
    return all ^ all >> 15;
}

__kernel void find_cells(__global const float *positions, __global const float *before,     // [V, 3]
                         __global const int *faces, int count, int mask, __global int *cell,
                         __global uchar *wrong,                                             // [F] TURNED, FLAT or 0
                         __global int *levels)                     // bits: grids that hold any triangle
{
    EACH(i, count)
    const Triangle t = triangle_at(positions, faces, i);
    atomic_or(levels, 1 << (t.level - FINEST));
    cell[i] = (int)(place_of(convert_int3(floor(0.5f * (t.low + t.high) * cells(t.level))), t.level) & (uint)mask);
    const float3 ab = t.b - t.a, ac = t.c - t.a, bc = t.c - t.b, now = cross(ab, ac);
    const float3 start = vload3(t.corner.x, before);
    const float3 then = cross(vload3(t.corner.y, before) - start, vload3(t.corner.z, before) - start);
    const float longest = fmax(dot(ab, ab), fmax(dot(ac, ac), dot(bc, bc)));
    wrong[i] = !(length(now) > NO_AREA * longest) ? FLAT : dot(now, then) < 0.0f ? TURNED : 0;
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

bool either(const Triangle s, const Triangle t)
{
    return pierces(s.a, s.b, t.a, t.b, t.c) || pierces(s.b, s.c, t.a, t.b, t.c) || pierces(s.c, s.a, t.a, t.b, t.c);
}

// Triangles that share a side do not cross; sides that end in a corner of the other triangle do not go through it.
bool cross_each_other(const Triangle s, const Triangle t)
{
    const int shared = any(s.corner.x == t.corner) + any(s.corner.y == t.corner) + any(s.corner.z == t.corner);
    return shared > 1 ? shared == 3 : either(s, t) || either(t, s);
}

// Where many triangles lie close together, as around a vertex of many, most of the time goes into reading those whose
// boxes are apart: read one after the other, not corner by corner.
__kernel void find_boxes(__global const float *positions, __global const int *faces, __global const int *order,
                         int count, __global float *boxes)         // [F, 2, 3] low, high
{
    EACH(k, count)
    const Triangle t = triangle_at(positions, faces, order[k]);
    vstore3(t.low, 2 * k, boxes);
    vstore3(t.high, 2 * k + 1, boxes);
}

__kernel void find_crossing(__global const float *positions, __global const int *faces, int count, int mask,
                            __global const int *levels,
                            __global const int *first,             // where those of each place that are watched begin,
                                                                   // and the others, in
                            __global const int *order,             // [F], by place
                            __global const uchar *watched,         // [F] two that are not are known not to cross
                            __global const float *boxes,           // [F, 2, 3], in this order
                            __global const int *part,              // [V] connected part of the mesh
                            __global int *crossing)                // [F] CROSSING and FOLDED, or 0
{
    EACH(i, count)
    const Triangle own = triangle_at(positions, faces, i);
    if (all(own.low == own.high))
        return;
    int crosses = 0;
    for (int level = own.level; level <= COARSEST; ++level) {
        if (!(*levels >> (level - FINEST) & 1))
            continue;
        const int3 low = convert_int3(floor(own.low * cells(level) - 0.5f));
        const int3 high = convert_int3(floor(own.high * cells(level) + 0.5f));
        for (int z = low.z; z <= high.z; ++z)
            for (int y = low.y; y <= high.y; ++y)
                for (int x = low.x; x <= high.x; ++x) {
                    const uint place = place_of((int3)(x, y, z), level) & (uint)mask;
                    for (int k = first[2 * place]; k < first[2 * place + 1 + watched[i]]; ++k) {
                        const int j = order[k];
                        if (j == i || (level == own.level && j < i))
                            continue;
                        if (any(vload3(2 * k, boxes) > own.high) || any(vload3(2 * k + 1, boxes) < own.low))
                            continue;
                        const int found = part[own.corner.x] == part[faces[3 * j]] ? FOLDED : CROSSING;
                        if ((crosses & found) && (atomic_or(&crossing[j], 0) & found))      // nothing new
                            continue;
                        if (!cross_each_other(own, triangle_at(positions, faces, j)))
                            continue;
                        crosses |= found;
                        atomic_or(&crossing[j], found);
                    }
                }
    }
    if (crosses)
        atomic_or(&crossing[i], crosses);
}
