"""What became of each pixel's depth, as cl_kernels/status.clh numbers it; DepthResult.status says what each means."""

NO_SURFACE, REFINED, KEPT, REJECTED = range(4)
