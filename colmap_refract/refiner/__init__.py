"""The refiner: from a COLMAP model that ignored refraction to one that does not, and how far to trust it."""
