"""The demonstration: a simulated drive, detectors with known faults, and what the fusion makes of them."""
