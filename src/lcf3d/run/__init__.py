"""A dataset through both branches and the fusion: setup, settings, frames, folder, sources, results."""
