// Depths from scene units to the device's units, and back (splat/units.py).
#include "constants.clh"

#define INFINITE 0x7f800000u

// A surface: a number above 0 that is finite. By its bits, which a device may not flush to 0.
bool is_surface(float d)
{
    return as_uint(d) - 1u < INFINITE - 1u;
}

// a / b as it is rounded, where the device's own division may be off by its last bits.
float quotient(float a, float b)
{
    const float near = a / b;
    return near + fma(-near, b, a) / b;
}

// Depth in units, 0 = no Gaussian; `depth` holds it already where it is `scaled`. bounds: the nearest and the farthest.
__kernel void normalize_depth(__global const float *given,         // [count] scene units
                              __global const uchar *visible,       // [count], null = all
                              int count, float scene_scale, int scaled, __global float *depth,
                              __global volatile uint *bounds)      // two depths, by their bits
{
    __local uint nearest, farthest;
    const int i = get_global_id(0);
    if (get_local_id(0) == 0) {
        nearest = INFINITE;
        farthest = 0;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    if (i < count) {
        const float d = scaled ? depth[i] : quotient(given[i], scene_scale);
        const bool valid = is_surface(given[i]) && d >= NEAR && d <= FAR && (!visible || visible[i]);
        depth[i] = valid ? d : 0.0f;
        if (valid) {
            atomic_min(&nearest, as_uint(d));
            atomic_max(&farthest, as_uint(d));
        }
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    if (get_local_id(0) == 0 && farthest > 0) {
        atomic_min(&bounds[0], nearest);
        atomic_max(&bounds[1], farthest);
    }
}

// Other depths for those that there are.
__kernel void start_from(__global const float *start,              // [count] scene units, 0 = as it is
                         int count, float scene_scale, __global float *depth)
{
    EACH(i, count)
    if (depth[i] > 0.0f && start[i] > 0.0f)
        depth[i] = quotient(start[i], scene_scale);
}

// What is given back of a view, in place; status as scene/depthmap.py has it.
__kernel void denormalize_depth(__global const float *given, int count, float scene_scale, __global float *depth,
                                __global float *parallax, __global uchar *status,
                                __global float *deviation)         // [count] all; units, scene units afterwards
{
    EACH(i, count)
    const uint kept = is_surface(given[i]) ? as_uint(given[i]) : 0u;
    const bool without_gaussian = status[i] == NO_SURFACE && kept;
    const uint found = status[i] == REFINED ? as_uint(depth[i] * scene_scale) : kept;
    ((__global uint *)depth)[i] = found;
    parallax[i] *= scene_scale;
    deviation[i] = without_gaussian ? INFINITY : deviation[i] * scene_scale;
    if (without_gaussian || (status[i] == REFINED && found == kept))
        status[i] = KEPT;
}
