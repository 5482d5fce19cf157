"""Tracks of a camera that stands still: every frame followed from the reference frame by optical flow."""
