"""How good a reconstruction from rendered images is: against what its keypoints really show."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from colmap_refract.errors import RefractError
from colmap_refract.interface import Array
from colmap_refract.simulation.accuracy import align, align_to_best
from colmap_refract.simulation.precision import Configuration, Precision, precision
from colmap_refract.simulation.truth import Truth

if TYPE_CHECKING:
    import pycolmap

Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

# A keypoint that shows another place than the others of its track, by more than this many of their median
# distances (and more than this many px, should they agree perfectly), is a wrong match.
WRONG_MATCH = 6.0
WRONG_MATCH_PX = 2.0
# Normal distributions: standard deviation over the median of the absolute deviation.
STD_OVER_MEDIAN = 1.4826


@dataclass(frozen=True, kw_only=True)
class Judgement:
    """A reconstruction against the truth; lengths are metres.

    The truth of a point is the mean of the places on the ground that its keypoints really show, wrong matches left
    out. So a detector that finds the same wrong place in all images is forgiven, and the ground's texture, whose
    features are spots rather than points, sets no limit.
    """

    num_points: int
    """Judged: of two keypoints or more that show one place."""
    num_observations: int
    """Of those points, wrong matches left out."""
    wrong_observations: int
    """Keypoints that show another place than the others of their track, or none."""
    wrong_points: int
    """Points without two keypoints that show one place; they are in no number below."""
    rmse: float
    """Root mean square distance of all points from their truth, aligned to all."""
    rmse_best90: float
    """Of the best 90 % of the points, aligned to those."""
    median_error: float
    """Of all points, aligned to the best 90 %."""
    surface_rms: float
    """Root mean square distance of the best 90 % of the points, so aligned, from the ground, along its normal."""
    surface_median: float
    """Median distance of all points from the ground, so aligned."""
    depth_rmse_best90: float
    """Along the optical axis of the first image: of the best 90 % of the points, so aligned."""
    constant_depth_rmse: float
    """That of the same points, if all were at their mean depth: what a fixed camera has without refraction."""
    keypoint_noise: float
    """Robust standard deviation of keypoints about the pixels where their points' truths are seen, px, per axis."""
    keypoint_rms: float
    """Root mean square of the same, px: larger, as detectors err more at times than a normal distribution does."""
    bound: float | None
    """RMSE that a noise of `keypoint_noise` allows with these very tracks, by Cramer and Rao; None: not asked for."""
    bound_best90: float | None
    """The same over the points of `rmse_best90`."""
    scale: float
    """Metres per unit of the model, by the alignment."""
    errors: Array = field(repr=False)
    """(P,) of the judged points, aligned to the best 90 %; in the order of `point3D_ids`."""
    point3D_ids: tuple[int, ...] = field(repr=False)

    def __str__(self) -> str:
        """The numbers with their units, one per line, without a final newline."""
        one_depth = f"{_mm(self.constant_depth_rmse)} if all had one depth"
        rows = {
            "Judged": f"{self.num_points} points, {self.num_observations} keypoints",
            "Left out, wrong matches": f"{self.wrong_points} points, {self.wrong_observations} keypoints",
            "Error of the points (rms)": _mm(self.rmse),
            "Error of the best 90 % (rms)": _mm(self.rmse_best90),
            "Error, median": _mm(self.median_error),
            "Off the ground, best 90 % (rms)": _mm(self.surface_rms),
            "Off the ground, median": _mm(self.surface_median),
            "Depth, best 90 % (rms)": f"{_mm(self.depth_rmse_best90)}; {one_depth}",
            "Noise of the keypoints": f"{self.keypoint_noise:.3g} px per axis, {self.keypoint_rms:.3g} px (rms)",
        }
        if self.bound is not None and self.bound_best90 is not None:
            rows["Allowed by that noise (rms)"] = f"{_mm(self.bound)}; {_mm(self.bound_best90)} for the best 90 %"
        rows["A unit of the model"] = f"{self.scale:.6g} m"
        return "\n".join(f"{label + ':':34s}{value}" for label, value in rows.items())


@dataclass(frozen=True, kw_only=True)
class Sightings:
    """The N keypoints of P points, and what they really show.

    Attributes:
        point, image: (N,) indices into the points, and into the truth's images.
        pixels: (N, 2).
        good: (N,) whether a keypoint shows the place of its point.
        places: (P, 3) the truth of each point; not a number without two good keypoints.
    """

    point: Index
    image: Index
    pixels: Array
    good: Mask
    places: Array


def judge(reconstruction: pycolmap.Reconstruction, truth: Truth, *, with_bound: bool = True) -> Judgement:
    """Compare a reconstruction from rendered images with the truth.

    Args:
        reconstruction: any model whose image names are the truth's; its frame and scale are free.
        truth: of the rendered images.
        with_bound: also the Cramer-Rao bound. It takes an array of observations x unknowns of the cameras, and is
            that of the mean planes where there are waves.

    Raises:
        RefractError: an image that the truth does not know, or fewer than ten points to judge.
    """
    ids = sorted(reconstruction.point3D_ids())
    sightings = sight(reconstruction, truth, ids)
    sound = np.flatnonzero(np.isfinite(sightings.places).all(axis=1))
    if len(sound) < 10:
        raise RefractError(f"{len(sound)} points have two keypoints that show one place; ten are needed to judge")
    found = np.array([reconstruction.points3D[ids[k]].xyz for k in sound])
    true = sightings.places[sound]

    everything = np.linalg.norm(align(found, true, found) - true, axis=1)
    aligned, best = align_to_best(found, true)
    errors = np.linalg.norm(aligned - true, axis=1)
    slope = truth.terrain.gradient(aligned[:, :2])
    above = (aligned[:, 2] - truth.terrain.height(aligned[:, :2])) / np.sqrt(1 + np.sum(slope**2, axis=1))
    axis = truth.views[0].cam_from_world[2, :3]
    residuals = keypoint_residuals(sightings, truth)
    noise = float(STD_OVER_MEDIAN * np.median(np.abs(residuals)))
    # One row per sound point, in their order.
    variance = noise**2 * np.einsum("pii->p", bound_of(sightings, truth).covariance) if with_bound else None
    used = sightings.good & np.isin(sightings.point, sound)
    return Judgement(
        num_points=len(sound),
        num_observations=int(used.sum()),
        wrong_observations=int((~sightings.good).sum()),
        wrong_points=len(ids) - len(sound),
        rmse=_rms(everything),
        rmse_best90=_rms(errors[best]),
        median_error=float(np.median(errors)),
        surface_rms=_rms(above[best]),
        surface_median=float(np.median(np.abs(above))),
        depth_rmse_best90=_rms(((aligned - true) @ axis)[best]),
        constant_depth_rmse=float(np.std((true @ axis)[best])),
        keypoint_noise=noise,
        keypoint_rms=_rms(residuals),
        bound=None if variance is None else float(np.sqrt(variance.mean())),
        bound_best90=None if variance is None else float(np.sqrt(variance[best].mean())),
        scale=_spread(aligned) / _spread(found),
        errors=errors,
        point3D_ids=tuple(ids[k] for k in sound.tolist()),
    )


def sight(reconstruction: pycolmap.Reconstruction, truth: Truth, ids: list[int]) -> Sightings:
    """What the keypoints of points really show.

    A keypoint is good if it shows the place that most of its track show: the coordinate-wise median at first. Two
    keypoints have no majority; they are both good, if they are near.
    """
    number = {name: k for k, name in enumerate(truth.names)}
    row = {point3D_id: k for k, point3D_id in enumerate(ids)}
    point, image, pixels, shown = [], [], [], []
    for seen in reconstruction.images.values():
        keypoints = seen.get_observation_points2D() if seen.has_pose else []
        mine = [point2D for point2D in keypoints if point2D.point3D_id in row]
        if not mine:
            continue
        if seen.name not in number:
            raise RefractError(
                f"the model's image '{seen.name}' is not one of the truth's; judge it with its own truth"
            )
        xy = np.array([point2D.xy for point2D in mine])
        point.append(np.array([row[point2D.point3D_id] for point2D in mine]))
        image.append(np.full(len(mine), number[seen.name]))
        pixels.append(xy)
        shown.append(truth.trace(seen.name, xy))
    if not point:
        raise RefractError("the model has no points to judge")
    of_point, of_image = np.concatenate(point), np.concatenate(image)
    xy, places = np.concatenate(pixels), np.concatenate(shown)

    valid = np.asarray(np.isfinite(places).all(axis=1))
    sample = np.array([_sample_distance(truth, k) for k in range(len(truth.names))])[of_image]
    middle = _group_median(places, of_point, valid, len(ids))
    away = np.linalg.norm(places - middle[of_point], axis=1)
    typical = _group_median(away[:, None], of_point, valid, len(ids))[of_point, 0]
    good = valid & (away <= np.maximum(WRONG_MATCH * typical, WRONG_MATCH_PX * sample))
    # Two that differ are no better than one: which of them is right?
    typical_px = typical / sample
    good &= typical_px < 2 * WRONG_MATCH_PX

    count = np.bincount(of_point[good], minlength=len(ids))
    total = np.zeros((len(ids), 3))
    np.add.at(total, of_point[good], places[good])
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(count[:, None] >= 2, total / count[:, None], np.nan)
    return Sightings(point=of_point, image=of_image, pixels=xy, good=good & (count[of_point] >= 2), places=mean)


def keypoint_residuals(sightings: Sightings, truth: Truth) -> Array:
    """The good keypoints about where their points' truths are seen, (K, 2) px.

    The truths come from the same keypoints: of n about a place on the ground, n - 1 are free, and residuals are
    enlarged by that. Those that have no path through the waves are left out.
    """
    count = np.bincount(sightings.point[sightings.good], minlength=len(sightings.places))
    residuals = []
    for k, name in enumerate(truth.names):
        mine = sightings.good & (sightings.image == k)
        if mine.any():
            xy, own = sightings.pixels[mine], sightings.point[mine]
            freedom = np.sqrt(count[own] / (count[own] - 1))
            residuals.append((truth.project(name, sightings.places[own], near=xy) - xy) * freedom[:, None])
    together = np.concatenate(residuals)
    return np.asarray(together[np.isfinite(together).all(axis=1)])


def bound_of(sightings: Sightings, truth: Truth) -> Precision:
    """The Cramer-Rao bound, for 1 px of noise, with the tracks as they are, wrong matches left out."""
    kept, of_point = np.unique(sightings.point[sightings.good], return_inverse=True)
    poses = np.array([view.cam_from_world for view in truth.views])
    _, first, frame = np.unique(truth.frames, return_index=True, return_inverse=True)
    rig = poses[first]
    turn = poses[:, :, :3] @ rig[frame][:, :, :3].mT
    shift = poses[:, :, 3] - np.einsum("iab,ib->ia", turn, rig[frame][:, :, 3])
    _, leader, plane = np.unique(truth.interfaces, return_index=True, return_inverse=True)
    if truth.scenario == "camera_housing":
        planes = truth.planes[leader]
    else:
        surfaces = [truth.views[k].surface for k in leader]
        planes = np.array([[*surface.normal, surface.offset] for surface in surfaces])
    camera_ids = sorted(truth.cameras)
    return precision(
        Configuration(
            scenario=truth.scenario,
            layers=truth.views[0].surface.layers,
            size=float(np.median(np.linalg.norm(truth.views[0].center - sightings.places[kept], axis=1))),
            point=of_point.astype(np.int64),
            image=sightings.image[sightings.good],
            frame=frame,
            plane=plane,
            camera=np.searchsorted(camera_ids, truth.camera_ids),
            points=sightings.places[kept],
            rig_from_world=rig,
            sensor_from_rig=np.concatenate([turn, shift[:, :, None]], axis=2),
            normal=planes[:, :3],
            offset=planes[:, 3],
            cameras=[truth.cameras[camera_id] for camera_id in camera_ids],
        )
    )


def _group_median(values: Array, group: Index, valid: Mask, count: int) -> Array:
    """Medians (count, C) of values (N, C) by group; not a number for groups without valid values."""
    out = np.full((count, values.shape[1]), np.nan)
    size = np.bincount(group[valid], minlength=count)
    first = np.cumsum(size) - size
    some = np.flatnonzero(size)
    for c in range(values.shape[1]):
        order = np.flatnonzero(valid)[np.lexsort((values[valid, c], group[valid]))]
        ranked = values[order, c]
        out[some, c] = 0.5 * (ranked[(first + (size - 1) // 2)[some]] + ranked[(first + size // 2)[some]])
    return out


def _sample_distance(truth: Truth, index: int) -> float:
    """Metres on the ground from pixel to pixel, the median over an image."""
    view = truth.views[index]
    grid = np.stack(np.meshgrid(*(np.linspace(0.1, 0.9, 5) * side for side in (view.camera.width, view.camera.height))))
    middle = grid.reshape(2, -1).T
    points = truth.trace(truth.names[index], np.concatenate([middle, middle + [1, 0], middle + [0, 1]])).reshape(
        3, -1, 3
    )
    steps = np.linalg.norm(points[1:] - points[0], axis=2)
    return float(np.nanmedian(steps)) if np.isfinite(steps).any() else np.nan


def _mm(metres: float) -> str:
    return f"{1000 * metres:.3g} mm"


def _spread(points: Array) -> float:
    return float(np.linalg.norm(points - points.mean(axis=0)))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
