"""The embedded demonstration: a street of boxes, detectors with known faults, and what the fusion makes of them."""
