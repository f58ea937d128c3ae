"""Detectors and the one-string way to name them."""
