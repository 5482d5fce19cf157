"""How near a model's points can be to the truth through waves that nobody knows, but for their statistics."""

from __future__ import annotations

import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array, tangent_basis
from colmap_refract.simulation.accuracy import configuration_of
from colmap_refract.simulation.capture import Capture
from colmap_refract.simulation.least_path import least_path_direction
from colmap_refract.simulation.point_elimination import CorrelatedNoise
from colmap_refract.simulation.precision import STEP, Configuration, precision
from colmap_refract.simulation.scene import SceneOptions, lay_out, plane_scatter
from colmap_refract.simulation.waves import WaveStatistics


def bayesian_bound(capture: Capture, *, level_prior: bool = False) -> float:
    """The least expected `point_rmse` of a solver that knows the statistics of the waves, metres.

    Unknown are points, poses, planes and waves, of which the waves are a random surface of the covariance that they
    are drawn with. To first order they make the pixels of a frame err together: with the noise `sigma`, the
    derivatives `G` of the pixels by height and slopes at the crossings, and the waves' covariance `K` there,

        C = sigma^2 I + G K G^T.

    It is linear, at the true points and poses and the mean planes: waves so short and steep that a point is seen
    several times, which say more (or other) than their first derivatives, are beyond it.

    Args:
        capture: of any scenario. Without waves and prior this is `noise_bound`.
        level_prior: the planes of moving interfaces are known to scatter about one common plane, itself
            unknown, as much as they do. It changes nothing for one static plane, nor for ports.

    Raises:
        RefractError: fewer than three points that have two observations which are no outliers, or waves without
            pixel noise.
    """
    options, configuration = capture.options, configuration_of(capture)
    moving = options.scenario in ("moving_interface", "fixed_camera")
    # All in units of the pixel noise, as `precision` is.
    prior = options.pixel_noise * _level_prior(configuration, options) if level_prior and moving else None
    noise = None
    if options.wave_slope_deg > 0:
        if options.pixel_noise == 0:
            raise RefractError("pixel_noise 0 leaves waves without a bound: give more")
        noise = _noise(configuration, options.wave_statistics, options.pixel_noise)
    return options.pixel_noise * precision(configuration, noise=noise, prior=prior).rmse


def _noise(configuration: Configuration, waves: WaveStatistics, pixel_noise: float) -> CorrelatedNoise:
    """Of all pixels through unknown waves, in units of the pixel noise; each frame has waves of its own."""
    crossing, by_surface = _by_surface(configuration)
    frame = configuration.frame[configuration.image]
    groups = [np.flatnonzero(frame == k) for k in np.unique(frame)]
    factors = []
    for group in groups:
        g, size = by_surface[group] / pixel_noise, len(group)
        half = (g @ waves.covariance(crossing[group, :2]).reshape(size, 3, 3 * size)).reshape(2 * size, size, 3)
        covariance = np.einsum("rmd,mbd->rmb", half, g).reshape(2 * size, 2 * size)
        factors.append(np.linalg.cholesky(covariance + np.eye(2 * size)))
    return CorrelatedNoise(groups=groups, factors=factors)


def _by_surface(configuration: Configuration) -> tuple[Array, Array]:
    """Where light crosses the mean planes (N, 3), world, and what the surface does to the pixels there (N, 2, 3).

    The derivatives are by the surface's z, dz/dx and dz/dy at the crossing. By Fermat's principle the pixel
    depends on the surface to first order through these alone, so a plane that touches it does in its place. Dry points
    have none.
    """
    pose, normal_in_cam, distance = (part[configuration.image] for part in configuration.views(np.zeros(12)))
    rotation, translation = pose[:, :, :3], pose[:, :, 3]
    in_cam = np.einsum("nab,nb->na", rotation, configuration.points[configuration.point]) + translation
    direction = least_path_direction(in_cam, normal_in_cam, distance, configuration.layers)
    reach = distance / np.einsum("na,na->n", direction, normal_in_cam)
    crossing = np.einsum("nba,nb->na", rotation, reach[:, None] * direction - translation)
    normal = np.einsum("nba,nb->na", rotation, normal_in_cam)

    def pixels(z: float, slope: Array) -> Array:
        touching = normal / normal[:, 2:] - [*slope, 0.0]
        touching /= np.linalg.norm(touching, axis=1, keepdims=True)
        offset = np.einsum("na,na->n", touching, crossing + [0, 0, z])
        in_view = np.einsum("nab,nb->na", rotation, touching)
        away = offset + np.einsum("na,na->n", in_view, translation)
        return configuration.pixels_of(least_path_direction(in_cam, in_view, away, configuration.layers))

    steps = np.diag([STEP * configuration.size, STEP, STEP])
    central = [(pixels(s[0], s[1:]) - pixels(-s[0], -s[1:])) / (2 * s.sum()) for s in steps]
    wet = np.einsum("na,na->n", in_cam, normal_in_cam) > distance
    return crossing, np.where(wet[:, None, None], np.stack(central, axis=-1), 0.0)


def _level_prior(configuration: Configuration, options: SceneOptions) -> Array:
    """Rows of `precision` (3B, C + 3): slopes and lift of each plane over a common one, by their standard deviations.

    The common plane, the last three unknowns, has two slopes and a z above the world's origin. A deviation of zero
    counts as that of the finite differences: as good as none.
    """
    targets = lay_out(options, np.random.default_rng(options.seed)).targets
    slope_std, lift_std = np.maximum(plane_scatter(options), [STEP, STEP * configuration.size])
    num_planes = len(configuration.normal)
    num_frames = 0 if options.scenario == "fixed_camera" else len(configuration.rig_from_world)
    rows = np.zeros((num_planes, 3, 6 * num_frames + 3 * num_planes + 3))
    for k, (normal, offset) in enumerate(zip(configuration.normal, configuration.offset, strict=True)):
        target = targets[k * options.frames_per_interface]
        turn, slope = tangent_basis(normal), -normal[:2] / normal[2]
        own = np.zeros((3, 3))
        own[:2, :2] = -(turn[:2] + np.outer(slope, turn[2])) / normal[2]
        own[2] = [*(target @ own[:2, :2] - offset * turn[2] / normal[2] ** 2), 1 / normal[2]]
        first = 6 * num_frames + 3 * k
        rows[k, :, first : first + 3] = own
        rows[k, :, -3:] = -np.array([[1, 0, 0], [0, 1, 0], [*target, 1]])
    rows /= np.array([slope_std, slope_std, lift_std])[:, None]
    return rows.reshape(3 * num_planes, -1)
