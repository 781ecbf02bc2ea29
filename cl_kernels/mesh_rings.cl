// Numbers grouped by what they are, and with that what is around each vertex of a mesh: its corners in the order of the
// triangles, and the two others of each (method section 10.2). Nothing depends on which work-item comes first.
#include "constants.clh"

// next: [V] how many numbers there are of each, from zero on
__kernel void count_numbers(__global const int *numbers, int count, __global int *next)
{
    EACH(k, count)
    atomic_inc(&next[numbers[k]]);
}

// order: [N] places of the numbers, each group's from `next` on, which begins where the groups do
__kernel void list_places(__global const int *numbers, int count, __global int *next, __global int *order)
{
    EACH(k, count)
    order[atomic_inc(&next[numbers[k]])] = k;
}

// Each group ascending: Shell's sort, since one may have thousands.
__kernel void sort_places(__global const int *first, int count, __global int *order)
{
    EACH(i, count)
    const int number = first[i + 1] - first[i];
    __global int *own = order + first[i];
    for (int gap = number / 2; gap > 0; gap /= 2)
        for (int k = gap; k < number; ++k) {
            const int next = own[k];
            int place = k;
            for (; place >= gap && own[place - gap] > next; place -= gap)
                own[place] = own[place - gap];
            own[place] = next;
        }
}

// pairs: [3 F] the two other corners of the triangle of each corner
__kernel void find_pairs(__global const int *faces, __global const int *order, int count, __global int2 *pairs)
{
    EACH(k, count)
    const int side = order[k] % 3, face = order[k] - side;
    pairs[k] = (int2)(faces[face + (side + 1) % 3], faces[face + (side + 2) % 3]);
}
