"""Readers of datasets, each yields Frames."""
