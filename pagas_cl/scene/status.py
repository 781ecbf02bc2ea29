"""What became of each pixel's depth; DepthResult.status says what each means."""

NO_SURFACE, REFINED, KEPT, REJECTED = range(4)
