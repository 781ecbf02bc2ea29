// Connected components of a mesh (method section 10.5): of each vertex the least one that it is connected with,
// whichever work-item comes first. `least` [V] is a vertex that is connected and not greater, from itself on; it only
// gets less.
#include "constants.clh"

// The least vertex that i is connected with, by what is known so far; the way there gets shorter.
int root_of(__global volatile int *least, int i)
{
    for (int next = atomic_or(&least[i], 0); next != i;) {
        const int over = atomic_or(&least[next], 0);
        if (over < next)
            atomic_min(&least[i], over);
        i = next;
        next = over;
    }
    return i;
}

// Of the roots of an edge's ends, the greater gets the other: again where another work-item was faster.
__kernel void connect(__global const int *faces, int count, __global volatile int *least)
{
    EACH(i, count)
    for (int side = 0; side < 2; ++side) {
        int a, b;
        do {
            a = root_of(least, faces[3 * i + side]);
            b = root_of(least, faces[3 * i + side + 1]);
        } while (a != b && atomic_cmpxchg(&least[max(a, b)], max(a, b), min(a, b)) != max(a, b));
    }
}

__kernel void find_components(__global volatile int *least, int count, __global int *component)      // [V]
{
    EACH(i, count)
    component[i] = root_of(least, i);
}
