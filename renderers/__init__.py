"""The rasterizer: objects in world units to frames, with exact coverage; looks lie in `looks/`."""
