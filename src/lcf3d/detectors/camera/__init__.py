"""Camera detectors."""
