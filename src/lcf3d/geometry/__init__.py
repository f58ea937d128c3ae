"""Pure functions on arrays: boxes, overlaps, cameras."""
