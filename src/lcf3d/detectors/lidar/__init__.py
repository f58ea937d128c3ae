"""LiDAR detectors."""
