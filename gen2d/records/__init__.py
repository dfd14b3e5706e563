"""Records passed between sampler, solver, renderer and files. This package imports `gen2d.core` only."""
