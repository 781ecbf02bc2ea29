// Kernels that are the same whatever is simulated and however work-items share an image, compiled as one program: PoCL
// reads each program anew when a process begins, 0.03 to 0.07 s whatever is in it.
#include "carry_over.cl"
#include "deviation.cl"
#include "evidence.cl"
#include "image_noise.cl"
#include "means.cl"
#include "mismatch.cl"
#include "resample.cl"
#include "starts.cl"
#include "step.cl"
#include "summary.cl"
#include "units.cl"
