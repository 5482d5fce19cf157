"""Photographs as they are on disk: image files, videos, and which of their frames to reconstruct from."""
