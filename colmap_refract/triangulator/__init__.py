"""Points re-triangulated through waves, with poses and mean planes that are known."""
