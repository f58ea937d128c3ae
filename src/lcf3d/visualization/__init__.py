"""Pictures of frames and of what the fusion decided."""
