// Noise and texture of a photo, from pixels spread over it: three rows of one number a pixel. Grey values are sums of
// the three channels, whole numbers from 0 to 765.
#include "constants.clh"

#define SLOPE 0                          // change from the pixel before to the one after
#define ROUGHNESS 1                      // second difference; of the smoothest pixels alone, once keep_smooth has run
#define TEXTURELESS 2                    // 1 where the photo changes by less than LITTLE to the pixel after, else 0
#define LITTLE (GRADIENT_LOW * 765)

float grey_at(__global const uchar4 *photo, int i)
{
    return photo[i].x + photo[i].y + photo[i].z;
}

__kernel void sample_noise(__global const uchar4 *photo, int width, int step_x, int step_y, int across, int count,
                           __global float *rows)                   // [3, count]
{
    EACH(k, count)
    const int i = k / across * step_y * width + k % across * step_x + 1;     // never a row's first or last pixel
    const float before = grey_at(photo, i - 1), here = grey_at(photo, i), after = grey_at(photo, i + 1);
    rows[SLOPE * count + k] = fabs(after - before);
    rows[ROUGHNESS * count + k] = fabs(before - 2.0f * here + after);
    rows[TEXTURELESS * count + k] = fabs(after - here) < LITTLE ? 1.0f : 0.0f;
}

// summary: of the row SLOPE, with the quantile up to which pixels are smooth.
__kernel void keep_smooth(__global const float4 *summary, int count, __global float *rows)
{
    EACH(k, count)
    if (rows[SLOPE * count + k] > floor(summary[SLOPE].z + 0.5f))
        rows[ROUGHNESS * count + k] = NAN;
}
