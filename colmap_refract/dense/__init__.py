"""Dense points and meshes of refined models: matches on a grid of a reference image, met by refracted rays."""
