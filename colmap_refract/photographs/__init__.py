"""Photographs as they are on disk: image files, videos, frames in their order."""
