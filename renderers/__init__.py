"""Rasterizer: scenes in metres to frames in pixels, with exact coverage. The looks are in `looks/`."""
