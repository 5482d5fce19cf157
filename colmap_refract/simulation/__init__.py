"""Simulated captures: scenes photographed through a plane interface, with or without waves, with the truth.

The projection here knows nothing of the solver's: the refracted ray is the path of least optical
length (Fermat), so an error in one is not hidden by the same error in the other.

The world's z axis points down into the water and its origin is at the height of the cameras, so the
floor lies at about z = `depth` and a level interface at z = `distance`. Lengths are metres.
"""

from colmap_refract.simulation.accuracy import noise_bound, point_rmse, slope_error
from colmap_refract.simulation.bayesian import bayesian_bound
from colmap_refract.simulation.capture import Capture, ignore_refraction, simulate
from colmap_refract.simulation.least_path import least_path_direction
from colmap_refract.simulation.scene import SceneOptions

__all__ = [
    "Capture",
    "SceneOptions",
    "bayesian_bound",
    "ignore_refraction",
    "least_path_direction",
    "noise_bound",
    "point_rmse",
    "simulate",
    "slope_error",
]
