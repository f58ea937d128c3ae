"""Training of the small networks: frustum localizer, LiDAR detector, camera detector; needs the extra ``train``."""
