"""Options of the pipeline, in COLMAP's spelling. `None` is COLMAP's own default, whatever it is in the version used."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from colmap_refract.errors import RefractError
from colmap_refract.optical_flow.options import FlowOptions

_PART_OF_IMAGE = 0.01
_LEAST_ERROR, _LEAST_POSE_ERROR = 4.0, 12.0
"""Pixels: COLMAP's defaults."""

Matcher = Literal["exhaustive", "sequential", "flow"]


@dataclass(frozen=True, kw_only=True)
class FeatureExtractionOptions:
    """How images are read for their features."""

    max_image_size: int | None = None
    """Larger images are reduced to this width or height, px."""
    use_gpu: bool | None = None
    """Of a COLMAP that was built for one."""


@dataclass(frozen=True, kw_only=True)
class SiftExtractionOptions:
    """COLMAP's SIFT features."""

    max_num_features: int | None = None
    """Per image; those of the largest scale are kept."""
    first_octave: int | None = None
    """-1: also at twice the image's size."""
    peak_threshold: float | None = None
    """Least contrast of a feature. Lower in murky water."""
    edge_threshold: float | None = None
    """Largest ratio of a feature's curvatures."""
    estimate_affine_shape: bool | None = None
    """Affine in place of oriented features: slower, better where views differ much."""
    domain_size_pooling: bool | None = None
    """Descriptors of several sizes, averaged: slower, more distinct."""
    upright: bool | None = None
    """All features upright."""


@dataclass(frozen=True, kw_only=True)
class FeatureMatchingOptions:
    """What is done with features of any kind."""

    use_gpu: bool | None = None
    """Of a COLMAP that was built for one."""
    guided_matching: bool | None = None
    """Match again along the epipolar lines. They are curved by refraction: of little use here."""
    max_num_matches: int | None = None
    """Per pair of images."""


@dataclass(frozen=True, kw_only=True)
class SiftMatchingOptions:
    """When two SIFT features match."""

    max_ratio: float | None = None
    """Largest ratio of the distances to the best and to the second best."""
    max_distance: float | None = None
    """Largest distance to the best."""
    cross_check: bool | None = None
    """Each must be the other's best."""


@dataclass(frozen=True, kw_only=True)
class ExhaustivePairingOptions:
    """Of the exhaustive matcher."""

    block_size: int | None = None
    """Images that are held in memory at once."""


@dataclass(frozen=True, kw_only=True)
class SequentialPairingOptions:
    """Of the sequential matcher: images are matched with those that follow by name."""

    overlap: int | None = None
    """Number of images that follow."""
    quadratic_overlap: bool | None = None
    """Also the images that follow after 2, 4, 8, ..."""
    loop_detection: bool | None = None
    """Also images that look alike. COLMAP fetches a vocabulary for it unless there is vocab_tree_path."""
    loop_detection_period: int | None = None
    """Every so many images."""
    loop_detection_num_images: int | None = None
    """Images that are looked up each time."""
    vocab_tree_path: Path | None = None
    """COLMAP's vocabulary tree."""


@dataclass(frozen=True, kw_only=True)
class TwoViewGeometryOptions:
    """Which matches of two images one straight-ray geometry explains."""

    min_num_inliers: int | None = None
    """Pairs with fewer are not used."""
    max_error: float | None = None
    """Distance from the epipolar line, px. By default 1 % of the images' longer side, and at least 4, COLMAP's."""
    confidence: float | None = None
    """Of RANSAC."""
    max_num_trials: int | None = None
    """Of RANSAC."""


@dataclass(frozen=True, kw_only=True)
class MapperOptions:
    """COLMAP's incremental mapper, which ignores refraction. Intrinsics are held: they would absorb it."""

    min_num_matches: int | None = None
    """Pairs with fewer verified matches are left out."""
    min_model_size: int | None = None
    """Images of a second model, at least."""
    multiple_models: bool | None = None
    """Go on with images that the first model does not reach."""
    max_num_models: int | None = None
    """At most."""
    init_image_id1: int | None = None
    """First image of the pair to begin with."""
    init_image_id2: int | None = None
    """Second image of the pair to begin with."""
    init_min_num_inliers: int | None = None
    """Matches of the pair to begin with."""
    init_max_error: float | None = None
    """Of the pair to begin with, px. By default 1 % of the images' longer side, and at least 4, COLMAP's."""
    init_min_tri_angle: float | None = None
    """Of the pair to begin with, degrees. COLMAP lowers it by itself where it finds none."""
    abs_pose_max_error: float | None = None
    """Of a point when an image is placed, px. By default 1 % of the images' longer side, and at least 12, COLMAP's."""
    abs_pose_min_num_inliers: int | None = None
    """Points that an image is placed by."""
    abs_pose_min_inlier_ratio: float | None = None
    """Part of an image's points that its pose explains."""
    filter_max_reproj_error: float | None = None
    """Observations with a larger straight-ray error, px, are removed.
    By default 1 % of the images' longer side, and at least 4, COLMAP's."""
    filter_min_tri_angle: float | None = None
    """Points whose rays meet at a smaller angle, degrees, are removed."""
    tri_min_angle: float | None = None
    """Least angle of a new point, degrees."""
    tri_merge_max_reproj_error: float | None = None
    """Of tracks that are merged, px. By default as filter_max_reproj_error."""
    tri_complete_max_reproj_error: float | None = None
    """Of tracks that are completed, px. By default as filter_max_reproj_error."""
    tri_ignore_two_view_tracks: bool | None = None
    """No points from two images only."""
    ba_global_max_num_iterations: int | None = None
    """Of the adjustment of all images."""
    ba_local_max_num_iterations: int | None = None
    """Of the adjustment about a new image."""


@dataclass(frozen=True, kw_only=True)
class ReconstructorOptions:
    """From photographs to a model that ignores refraction, and what the refiner makes of it."""

    matcher: Matcher = "exhaustive"
    """exhaustive: every image with every other; sequential: with those that follow by name.
    flow (fixed_camera only): optical flow against a reference frame, in place of features."""
    refine: bool = True
    """0: stop after COLMAP's own mapping."""
    complete_tracks: bool = True
    """Give tracks back, with refracted rays, what verification and mapping with straight rays took from them."""
    FeatureExtraction: FeatureExtractionOptions = FeatureExtractionOptions()
    SiftExtraction: SiftExtractionOptions = SiftExtractionOptions()
    FeatureMatching: FeatureMatchingOptions = FeatureMatchingOptions()
    SiftMatching: SiftMatchingOptions = SiftMatchingOptions()
    ExhaustivePairing: ExhaustivePairingOptions = ExhaustivePairingOptions()
    SequentialPairing: SequentialPairingOptions = SequentialPairingOptions()
    TwoViewGeometry: TwoViewGeometryOptions = TwoViewGeometryOptions()
    Mapper: MapperOptions = MapperOptions()
    Flow: FlowOptions = FlowOptions()

    def __post_init__(self) -> None:
        pair = (self.Mapper.init_image_id1, self.Mapper.init_image_id2)
        if (pair[0] is None) != (pair[1] is None):
            raise RefractError("only one of Mapper.init_image_id1 and Mapper.init_image_id2 is given; give both")


def widened(options: ReconstructorOptions, longer_side: int) -> ReconstructorOptions:
    """Limits in pixels that are not given, wide enough for straight rays.

    What straight rays miss refracted ones by is a part of the image, whatever its number of pixels. In trials through
    moving water, half of this limit cost accuracy after the refinement, and twice of it brought none. Wrong matches
    that pass are removed later, by their refracted rays.

    Args:
        options: not altered.
        longer_side: of the images, px.
    """
    limit = _PART_OF_IMAGE * longer_side
    mapper, geometry = options.Mapper, options.TwoViewGeometry
    error = max(_LEAST_ERROR, limit)
    filtered = _or(mapper.filter_max_reproj_error, error)
    mapper = replace(
        mapper,
        init_max_error=_or(mapper.init_max_error, error),
        abs_pose_max_error=_or(mapper.abs_pose_max_error, max(_LEAST_POSE_ERROR, limit)),
        filter_max_reproj_error=filtered,
        tri_merge_max_reproj_error=_or(mapper.tri_merge_max_reproj_error, filtered),
        tri_complete_max_reproj_error=_or(mapper.tri_complete_max_reproj_error, filtered),
    )
    geometry = replace(geometry, max_error=_or(geometry.max_error, error))
    return replace(options, Mapper=mapper, TwoViewGeometry=geometry)


def _or(value: float | None, default: float) -> float:
    return default if value is None else value


def given(group: Any) -> dict[str, Any]:
    """The options of a group that are not left to COLMAP, as numbers and texts."""
    return {
        name: str(value) if isinstance(value, Path) else value
        for name, value in asdict(group).items()
        if value is not None
    }
