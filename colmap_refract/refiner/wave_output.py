"""What a solution with waves leaves beside the model: a surface per image, and what is known of the waves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from colmap_refract.estimator.random_surface import Modes, closest_surface
from colmap_refract.files.sidecar import Sidecar
from colmap_refract.interface import Array
from colmap_refract.refiner.arrangement import Arrangement
from colmap_refract.refiner.soft import SoftSolution
from colmap_refract.water_surface import sampled

_CORRELATION_PER_WAVELENGTH = 1.0 / (np.sqrt(2.0) * np.pi)
"""A sinusoid near its crests is like a field of this correlation length."""


def add_waves(
    sidecar: Sidecar,
    arrangement: Arrangement,
    soft: SoftSolution,
    scale: float,
    on_image: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Put the surfaces and the statistics of the waves into the sidecar; lengths become the output's by `scale`.

    `on_image` is called before each image, with how many are done, of how many.
    """
    problem, statistics = soft.wavy.problem, soft.statistics
    tracks = problem.tracks
    normal, distance = problem.state.planes_in_cam(problem.structure)
    for i, name in enumerate(arrangement.observations.image_names):
        on_image(i, len(soft.wavy.modes))
        shapes = soft.wavy.modes[i]
        if shapes is None:
            continue
        mine = tracks.image == i
        coefficients = problem.state.waves[i, : shapes.shapes.shape[1]]
        if statistics.free_slopes:
            shapes, coefficients = closest_surface(shapes, coefficients)

        def heights(at: Array, shapes: Modes = shapes, coefficients: Array = coefficients) -> Array:
            return np.asarray(shapes.at(at)[:, 0] @ coefficients)

        axes = problem.structure.wave_axes[i]
        foot = tracks.sight[mine] / (tracks.sight[mine] @ normal[i])[:, None]
        surface = sampled(
            heights,
            foot @ axes,
            axes=axes,
            correlation_length=shapes.surface.wavelength * _CORRELATION_PER_WAVELENGTH,
            slope_deviation=statistics.slope_deviation,
        )
        sidecar.images[name] = replace(sidecar.images[name], surface=surface.scaled(scale * float(distance[i])))
    typical = scale * float(np.nanmedian(distance))
    given = arrangement.options
    total = statistics.total_slope(soft.wavy.explained)
    waves = {
        "slope_deviation_deg": given.wave_slope_deg or float(np.degrees(np.arctan(total))),
        "explained": soft.wavy.explained,
        "noise_px": statistics.noise,
        "log_likelihood": soft.log_likelihood,
    }
    # Of waves that no surface takes the length is a guess.
    if given.wavelength is not None:
        waves["wavelength"] = given.wavelength
    elif soft.wavy.explained > 0:
        waves["wavelength"] = statistics.wavelength * typical
    # Without a surface the scatter of the planes is not estimated.
    if soft.level is not None and soft.wavy.explained > 0:
        waves["level_tilt_deg"] = float(np.degrees(soft.level.tilt))
        waves["level_lift"] = soft.level.lift
    sidecar.statistics["waves"] = waves
