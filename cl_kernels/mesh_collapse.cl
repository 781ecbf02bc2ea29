// Edges of a mesh collapsed down to one of their ends, in rounds of many that do not touch (method section 10.4). Places
// are in the frame of the mesh, `unit` the footprint there.
//
// faces [F, 3] and wedges [F, 3]: places of the corners, and what sits there (one number for all corners of a place that
// share it); faces[3 f] < 0: gone. around[first[v] .. first[v + 1]]: corners of v by rows, and, in the same way, of
// next[v], which collapsed into it, of next[next[v]] and so on; last[v] ends that list. A vertex has a quadric of all
// triangles that it stands for; what others collapsed into moves to where that is least.
#include "constants.clh"
#include "quadric.clh"
#include "ring.clh"

#define BORDER 10.0f                     // weight of the planes across borders and seams, of a square of their edge
#define TURN 0.2f                        // least cosine between normals of a triangle before and after
#define SLIM 0.05f                       // height over longest edge, below which no triangle gets slimmer
#define STILL 0.01f                      // footprints: a vertex does not move by less
#define FREE 0                           // state: may collapse and move
#define PINNED 1                         // may collapse
#define KEPT 2                           // others may collapse into it
#define GONE 3

// quadrics: [V] of the planes of the faces around each vertex; vertices on borders and seams become PINNED
__kernel void find_quadrics(__global const float *positions, __global const float *unit, __global const int *faces,
                            __global const int *wedges, __global const int *first, __global const int *around,
                            __global const int *next, int count, __global Quadric *quadrics, __global uchar *state)
{
    EACH(u, count)
    Quadric q = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f};
    const float3 p = vload3(u, positions);
    const float scale = 1.0f / (unit[u] * unit[u]);
    Ring ring;
    find_ring(&ring, u, faces, wedges, first, around, next);
    EACH_FACE(face, u) {
        const int side = side_of(u, faces, face), a = faces[3 * face + (side + 1) % 3];
        const int b = faces[3 * face + (side + 2) % 3];
        const float3 to_a = vload3(a, positions) - p, to_b = vload3(b, positions) - p, across = cross(to_a, to_b);
        const float area = length(across) / 6.0f * scale;
        if (!(area > 0.0f))
            continue;
        const float3 n = normalize(across);
        q.area += area;
        add_plane(&q, n, area * scale);
        for (int k = 0; k < ring.number && !ring.wrong; ++k) {
            const float3 edge = ring.vertex[k] == a ? to_a : to_b;
            if (ring.seam[k] && (ring.vertex[k] == a || ring.vertex[k] == b))
                add_plane(&q, normalize(cross(edge, n)), BORDER / 6.0f * dot(edge, edge) * scale * scale);
        }
    }
    quadrics[u] = q;
    if (state[u] == FREE && (ring.wrong || ring.features))
        state[u] = PINNED;
}

// Whether triangles around a vertex, but those that go, stay as they face, and none gets too slim, where it moves by d:
// into its k-th neighbour, or into none (k < 0).
bool stays_whole(const Ring *ring, const float3 *to, int k, float3 d)
{
    for (int i = 0; i < ring->faces; ++i) {
        const int a = ring->after[i], b = ring->before[i];
        if (a == k || b == k)
            continue;
        const float3 old = cross(to[a], to[b]), new = cross(to[a] - d, to[b] - d);
        if (!(dot(old, new) > TURN * length(old) * length(new)))
            return false;
        const float third = dot(to[a] - to[b], to[a] - to[b]);
        const float3 ka = to[a] - d, kb = to[b] - d;
        const float slim = length(new) / fmax(third, fmax(dot(ka, ka), dot(kb, kb)));
        const float was = length(old) / fmax(third, fmax(dot(to[a], to[a]), dot(to[b], to[b])));
        if (slim < fmin(SLIM, was))
            return false;
    }
    return true;
}

// Whether no vertex is a neighbour of both but those of the faces between them.
bool linked_once(const Ring *ring, int k, __global const int *faces, __global const int *first,
                 __global const int *around, __global const int *next)
{
    const int v = ring->vertex[k];
    bool both[RING];
    for (int i = 0; i < ring->number; ++i)
        both[i] = false;
    EACH_FACE(face, v)
        for (int side = 0; side < 3; ++side)
            for (int i = 0; i < ring->number; ++i)
                both[i] = both[i] || ring->vertex[i] == faces[3 * face + side];
    int shared = 0;
    for (int i = 0; i < ring->number; ++i)
        shared += both[i] && i != k;
    return shared == ring->times[k];
}

// target: [V] the neighbour that a vertex costs least to collapse into, or -1; cost: [V] that; changed: [V] whether
// there is another answer since the last time
__kernel void choose(__global const float *positions, __global const Quadric *quadrics, __global const uchar *state,
                     __global const int *faces, __global const int *wedges, __global const int *first,
                     __global const int *around, __global const int *next, __global const uchar *changed, int count,
                     float most, __global int *target, __global float *cost)
{
    EACH(u, count)
    if (state[u] > PINNED || !changed[u])
        return;
    Ring ring;
    find_ring(&ring, u, faces, wedges, first, around, next);
    int best = -1;
    float least = INFINITY;
    if (!ring.wrong && (ring.features == 0 || ring.features == 2)) {
        const float3 p = vload3(u, positions);
        const Quadric q = quadrics[u];
        float3 to[RING];
        for (int k = 0; k < ring.number; ++k)
            to[k] = vload3(ring.vertex[k], positions) - p;
        for (int k = 0; k < ring.number; ++k) {
            const int v = ring.vertex[k];
            const Quadric both = joined(q, to[k], quadrics[v]);
            const float error = state[v] == FREE ? at(both, to_least(both)) : both.offset;
            if (error < least && error <= most * both.area && (ring.features == 0 || ring.seam[k])
                    && stays_whole(&ring, to, k, to[k]) && linked_once(&ring, k, faces, first, around, next)) {
                least = error;
                best = v;
            }
        }
    }
    target[u] = best;
    cost[u] = least;
}

// Equal costs, as on planes, are in an order that has nothing to do with where vertices lie.
uint shuffled(uint v)
{
    v = (v ^ v >> 16) * 0x45d9f3bu;
    v = (v ^ v >> 16) * 0x45d9f3bu;
    return v ^ v >> 16;
}

bool comes_before(int u, int v, __global const float *cost)
{
    return cost[u] < cost[v] || (cost[u] == cost[v] && shuffled(u) < shuffled(v));
}

// chosen: [V] how many faces go with a vertex that costs less than all others within two edges, 0 = it does not
__kernel void pick(__global const int *faces, __global const int *first, __global const int *around,
                   __global const int *next, __global const int *target, __global const float *cost, int count,
                   float limit, __global uchar *chosen)
{
    EACH(u, count)
    chosen[u] = 0;
    if (target[u] < 0 || !(cost[u] <= limit))
        return;
    int number = 0;
    EACH_FACE(face, u)
        for (int side = 0; side < 3; ++side) {
            const int v = faces[3 * face + side];
            number += v == target[u];
            if (target[v] >= 0 && comes_before(v, u, cost))
                return;
        }
    EACH_FACE(face, u)
        for (int side = 0; side < 3; ++side) {
            const int v = faces[3 * face + side];
            if (v == u)
                continue;
            EACH_FACE(near, v)
                for (int k = 0; k < 3; ++k) {
                    const int w = faces[3 * near + k];
                    if (target[w] >= 0 && comes_before(w, u, cost))
                        return;
                }
        }
    chosen[u] = number;
}

// received: [V] number of the round in which another vertex collapsed into it
__kernel void collapse(__global const float *positions, __global const int *first, __global const int *around,
                       __global const uchar *chosen, int count, int number, __global int *next, __global int *last,
                       __global int *faces, __global int *wedges, __global uchar *state, __global int *target,
                       __global float *cost, __global Quadric *quadrics, __global uchar *changed,
                       __global int *received)
{
    EACH(u, count)
    if (!chosen[u])
        return;
    const int v = target[u];
    received[v] = number;
    int from = -1, to[2] = {-1, -1};       // wedges of u on one side of the edge, of v on that side and on the other
    EACH_FACE(face, u) {
        const int side = side_of(u, faces, face);
        for (int k = 1; k < 3; ++k)
            if (faces[3 * face + (side + k) % 3] == v) {
                const int own = wedges[3 * face + side], other = wedges[3 * face + (side + k) % 3];
                if (from < 0)
                    from = own;
                to[own != from] = other;
            }
    }
    EACH_FACE(face, u) {
        const int side = side_of(u, faces, face);
        bool between = false;
        for (int k = 0; k < 3; ++k) {
            changed[faces[3 * face + k]] = 1;
            between = between || faces[3 * face + k] == v;
        }
        faces[3 * face + side] = v;
        wedges[3 * face + side] = to[wedges[3 * face + side] != from];
        if (between)
            faces[3 * face] = -1;
    }
    quadrics[v] = joined(quadrics[u], vload3(v, positions) - vload3(u, positions), quadrics[v]);
    EACH_FACE(face, v)
        for (int k = 0; k < 3; ++k)
            changed[faces[3 * face + k]] = 1;
    next[last[v]] = u;
    last[v] = last[u];
    state[u] = GONE;
    target[u] = -1;
    cost[u] = INFINITY;
}

// What others collapsed into in this round moves to where its quadric is least; of two neighbours only one.
__kernel void reposition(__global const int *faces, __global const int *wedges, __global const int *first,
                         __global const int *around, __global const int *next, __global const uchar *state,
                         __global const int *received, __global const float *unit, int count, int number,
                         __global float *positions, __global Quadric *quadrics)
{
    EACH(v, count)
    if (received[v] != number || state[v] != FREE)
        return;
    const float3 d = to_least(quadrics[v]), p = vload3(v, positions);
    Ring ring;
    find_ring(&ring, v, faces, wedges, first, around, next);
    if (ring.wrong || !(length(d) >= STILL * unit[v]))
        return;
    float3 to[RING];
    for (int k = 0; k < ring.number; ++k) {
        const int w = ring.vertex[k];
        if (received[w] == number && shuffled(w) < shuffled(v))
            return;
        to[k] = vload3(w, positions) - p;
    }
    if (!stays_whole(&ring, to, -1, d))
        return;
    quadrics[v] = around_there(quadrics[v], d);
    vstore3(p + d, v, positions);
}
