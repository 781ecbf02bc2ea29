// Which of the surfaces next to an edge of depth a pixel shows (method section 8.4): of its own depth and those of the
// planes around it that which more depth maps of other views confirm and its colour fits much better.
//   extend_planes     candidates: the pixel's own inverse depth, and that of planes around it that are other surfaces
//   list_supported    where there are candidates that other views support more than the pixel's own
//   score_colors      difference from the colour in one context photo under each of these, at `places`
//   choose_surface    the best of them, where it is clearly better
// candidates: [1 + AROUND, H, W] units^-1, 0 = none, in the first where the pixel has no other
// support: [1 + AROUND, H, W] by other views' depth maps (agreement.cl:count_support)
#include "lookup.clh"
#include "planes.clh"

#define NUMBER (1 + AROUND)
#define ANOTHER 0.5f                     // pixels of parallax from which on a plane is another surface
#define BETTER 0.6f                      // share of the own colour's difference that another one may have,
#define BETTER_GREY 0.2f                 // its cube where the pixel is grey: one number says less than three

// scale: units per scene unit, in which `depth_per_parallax` comes.
// own_depth, in scene units: of each pixel before the average with other views, which would confirm that in any case.
__kernel void extend_planes(__global const float *depth, __global const float *own_depth,
                            __global const float *depth_per_parallax, __global const uchar *status, float scale,
                            int width, int height, __global float *candidates, __global char *support)
{
    EACH_PIXEL(x, y, i, width, height)
    const int count = width * height;
    const float own = 1.0f / (own_depth[i] * scale), least = ANOTHER * depth_per_parallax[i] * scale * own * own;
    const bool may = depth[i] > 0.0f && least > 0.0f;
    bool found = false;
    support[i] = 0;
    for (int j = 0; j < AROUND; ++j) {
        const int2 near = (int2)(x, y) + NEIGHBOUR[j];
        float inverse = 0.0f;
        if (may && all(near >= 0) && near.x < width && near.y < height && status[near.y * width + near.x] == REFINED)
            inverse = extended(plane_at(depth, near.x, near.y, width, height), j);
        const bool is_other = inverse > 0.0f && fabs(inverse - own) > least;
        candidates[(1 + j) * count + i] = is_other ? inverse : 0.0f;
        support[(1 + j) * count + i] = 0;
        found |= is_other;
    }
    candidates[i] = found ? own : 0.0f;
}

bool is_supported(__global const float *candidates, __global const char *support, int j, int i, int count)
{
    return candidates[j * count + i] > 0.0f && support[j * count + i] > support[i];
}

__kernel void list_supported(__global const float *candidates, __global const char *support, int count,
                             __global uchar *supported)                        // [H, W]
{
    EACH(i, count)
    bool any = false;
    for (int j = 1; j < NUMBER; ++j)
        any |= is_supported(candidates, support, j, i, count);
    supported[i] = any;
}

__kernel void score_colors(__global const float *candidates, __global const char *support, __constant float *cameras,
                           int view, __global const uchar4 *target_photo, __global const uchar4 *photo,
                           __global const int *places, int count,
                           __global float *costs)                              // [views, NUMBER, count]
{
    EACH(k, count)
    const Camera target = load_camera(cameras, 0), context = load_camera(cameras, view);
    const int i = places[k], pixels = target.width * target.height;
    const float3 q = turned_ray(target, context, i % target.width, i / target.width), own = rgb_of(target_photo[i]);
    for (int j = 0; j < NUMBER; ++j) {
        float cost = UNDEFINED;
        float3 color;
        if (j == 0 || is_supported(candidates, support, j, i, pixels)) {
            const float3 mean = project_ray(context, q, 1.0f / candidates[j * pixels + i]);
            if (mean.z > NEAR && look_up(photo, context, mean.xy, &color))
                cost = dot(fabs(color - own), (float3)(1.0f / 3.0f));
        }
        costs[((view - 1) * NUMBER + j) * count + k] = cost;
    }
}

// A depth that photos had refused is refined then, and as sure as that of the plane's pixel, which is.
__kernel void choose_surface(__global const float *candidates, __global const float *costs, int views, int width,
                             int height, __global const uchar4 *target_photo, __global const int *places, int count,
                             float scale,
                             __global float *depth, __global float *deviation, __global uchar *status)  // scene units
{
    EACH(k, count)
    const int i = places[k];
    const uchar4 color = target_photo[i];
    const bool grey = color.x == color.y && color.y == color.z;
    const float own = better_half(costs + k, views, NUMBER * count);
    float least = own < UNDEFINED ? (grey ? BETTER_GREY : BETTER) * own : 0.0f;
    int best = 0;
    for (int j = 1; j < NUMBER; ++j) {
        const float cost = better_half(costs + j * count + k, views, NUMBER * count);
        if (cost < least) {
            least = cost;
            best = j;
        }
    }
    if (best == 0)
        return;
    depth[i] = 1.0f / (candidates[best * width * height + i] * scale);
    if (status[i] != REFINED) {
        status[i] = REFINED;
        deviation[i] = deviation[i + NEIGHBOUR[best - 1].y * width + NEIGHBOUR[best - 1].x];
    }
}
