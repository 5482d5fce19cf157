"""A camera from pictures of a flat board in air: its corners found, its parameters with their standard deviations."""
