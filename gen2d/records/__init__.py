"""Records that travel between sampler, solver, renderer and files; they may import `core` alone."""
