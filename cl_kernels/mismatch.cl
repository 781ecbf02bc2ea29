// Detail of a refined depth map that photos do not support is taken back (method section 5.2). Detail is what the
// change of a depth, counted from the initial one, has beyond its own average around it, on one surface.
//   find_changes     pixels of parallax, by inverse depth
//   smooth_changes   averaged with both neighbours a few pixels away, along one axis; several times gives the average
//   weigh_detail     square of the detail over the variance that the photos leave; the mean around a pixel decides
//   sample_detail    the share of the detail that is noise, and how well photos resolve the bends, on a grid of samples
//   take_back        that share goes
#include "lookup.clh"

#define EDGE 1.0f                    // pixels of parallax between initial depths: another surface
#define LEAST_INFORMATION 4.0f       // per squared pixel of parallax: as little information as counts
#define FINE 0.03f                   // pixels of parallax: smaller detail is left as it is
#define NOISE 6.0f                   // variance of the detail of errors alone, of that which the photos leave

// Change of a depth beyond its average, pixels of parallax.
float detail_of(float d0, float d, float u, float smooth)
{
    return d0 * (d - d0) / (d * u) - smooth;
}

__kernel void find_changes(__global const float *initial, __global const float *depth,
                           __global const float *depth_per_parallax, __global const uchar *status, int count,
                           __global float *changes)
{
    EACH(i, count)
    const float d0 = initial[i], d = depth[i];
    changes[i] = status[i] == REFINED ? detail_of(d0, d, depth_per_parallax[i], 0.0f) : 0.0f;
}

__kernel void smooth_changes(__global const float *initial, __global const float *depth_per_parallax,
                             __global const uchar *status, __global const float *changes, int width, int height,
                             int dx, int dy, __global float *smooth)
{
    EACH_PIXEL(column, row, i, width, height)
    const float d0 = initial[i], own = changes[i];
    float sum = 0.0f;
    for (int side = -1; side <= 1; side += 2) {
        const int x = column + side * dx, y = row + side * dy, k = y * width + x;
        if (x >= 0 && y >= 0 && x < width && y < height && status[k] == REFINED
            && fabs(initial[k] - d0) * d0 < EDGE * depth_per_parallax[i] * initial[k])
            sum += changes[k] - own;
    }
    smooth[i] = own + 0.25f * sum;
}

__kernel void weigh_detail(__global const float *initial, __global const float *depth,
                           __global const float *depth_per_parallax, __global const uchar *status,
                           __global const float *evidence,         // [H, W, 3] of one in `every` views
                           __global const float *smooth, int count, float every,
                           __global float *values)                 // [H, W, 2]
{
    EACH(i, count)
    const float d0 = initial[i], d = depth[i], u = depth_per_parallax[i];
    const float detail = detail_of(d0, d, u, smooth[i]);
    const bool known = status[i] == REFINED;
    const float information = fmax(every * vload3(i, evidence).z * u * u, LEAST_INFORMATION);
    vstore2(known ? (float2)(detail * detail * information, 1.0f) : 0.0f, i, values);
}

// Pixels of parallax by which the surface bends at i, along rows and columns; NaN where it ends.
float bend_at(__global const float *depth, int i, int width, float u)
{
    const float d = depth[i], left = depth[i - 1], right = depth[i + 1], above = depth[i - width],
                below = depth[i + width];
    return left > 0.0f && right > 0.0f && above > 0.0f && below > 0.0f
        ? (fabs(second_difference(left, d, right)) + fabs(second_difference(above, d, below))) * d * d / u : NAN;
}

// Share of the detail around a pixel that is noise.
float noise_in(__global const float *sums, int i)
{
    const float2 sum = vload2(i, sums);
    return fmin(NOISE * sum.y / fmax(sum.x, 1e-12f), 1.0f);
}

__kernel void sample_detail(__global const float *initial, __global const float *depth,
                            __global const float *depth_per_parallax, __global const uchar *status,
                            __global const float *sums, __global const float *smooth,
                            __global const float *evidence, float every, __global const float *of_all,
                            __constant float *cameras,
                            int stride, int across, int count, __global float *rows)               // [2, samples]
{
    const Camera target = load_camera(cameras, 0);
    EACH(k, count)
    const int2 at = sample_place(k, stride, across, target);
    const int i = at.y * target.width + at.x;
    const float u = depth_per_parallax[i], detail = detail_of(initial[i], depth[i], u, smooth[i]);
    const bool inside = at.x > 0 && at.y > 0 && at.x < target.width - 1 && at.y < target.height - 1;
    const float bend = status[i] == REFINED && inside ? bend_at(depth, i, target.width, u) : NAN;
    const float information = fmax(every * vload3(i, evidence).z, vload3(i, of_all).z);     // where less is noise
    rows[count + k] = information * u * u * bend * bend;
    rows[k] = status[i] != REFINED ? NAN : fabs(detail) < FINE ? 0.0f : noise_in(sums, i);
}

// measured: of the rows of sample_detail (summary.cl); the first one's quantile is to be more than `enough`.
__kernel void take_back(__global const float *initial, __global const float *depth_per_parallax,
                        __global const uchar *status, __global const float *sums, __global const float *smooth,
                        __global const float4 *measured, int always, float enough, int count, __global float *depth)
{
    if (!always && !(measured[0].z > enough))
        return;
    EACH(i, count)
    const float d0 = initial[i], d = depth[i], u = depth_per_parallax[i];
    if (status[i] != REFINED)
        return;
    const float kept = smooth[i] + (1.0f - noise_in(sums, i)) * detail_of(d0, d, u, smooth[i]);
    const float nearer = 1.0f - kept * u / d0;       // beyond all distances where a change is as large as the depth
    depth[i] = nearer > NEAR ? d0 / nearer : d;
}
