"""Our options on pycolmap's option objects."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from colmap_refract.errors import RefractError
from colmap_refract.files.quiet import quiet_pycolmap
from colmap_refract.reconstructor.options import ReconstructorOptions, given

if TYPE_CHECKING:
    import pycolmap


def extraction_options(options: ReconstructorOptions, num_threads: int) -> pycolmap.FeatureExtractionOptions:
    """For `pycolmap.extract_features`."""
    import pycolmap

    target = pycolmap.FeatureExtractionOptions()
    _set(target, given(options.FeatureExtraction))
    _set(target.sift, given(options.SiftExtraction))
    target.num_threads = num_threads
    return target


def matching_options(options: ReconstructorOptions, num_threads: int) -> pycolmap.FeatureMatchingOptions:
    """For pycolmap's matchers."""
    import pycolmap

    target = pycolmap.FeatureMatchingOptions()
    _set(target, given(options.FeatureMatching))
    _set(target.sift, given(options.SiftMatching))
    target.num_threads = num_threads
    return target


def pairing_options(
    options: ReconstructorOptions, num_threads: int
) -> pycolmap.ExhaustivePairingOptions | pycolmap.SequentialPairingOptions:
    """Of the matcher that is asked for."""
    import pycolmap

    if options.matcher == "sequential":
        sequential = pycolmap.SequentialPairingOptions()
        _set(sequential, given(options.SequentialPairing))
        sequential.num_threads = num_threads
        return sequential
    exhaustive = pycolmap.ExhaustivePairingOptions()
    _set(exhaustive, given(options.ExhaustivePairing))
    return exhaustive


def verification_options(options: ReconstructorOptions, random_seed: int) -> pycolmap.TwoViewGeometryOptions:
    """Of RANSAC for two images."""
    import pycolmap

    target = pycolmap.TwoViewGeometryOptions()
    values = given(options.TwoViewGeometry)
    for name in ("confidence", "max_num_trials", "max_error"):
        if name in values:
            _set(target.ransac, {name: values.pop(name)})
    _set(target, values)
    target.ransac.random_seed = random_seed
    return target


def mapping_options(
    options: ReconstructorOptions, num_threads: int, random_seed: int
) -> pycolmap.IncrementalPipelineOptions:
    """For `pycolmap.incremental_mapping`, the intrinsics held as far as options do that (see `models`)."""
    import pycolmap

    target = pycolmap.IncrementalPipelineOptions()
    for name, value in given(options.Mapper).items():
        if name.startswith("tri_"):
            _set(target.triangulation, {name.removeprefix("tri_"): value})
        else:
            _set(target if hasattr(target, name) else target.mapper, {name: value})
    target.ba_refine_focal_length = False
    target.ba_refine_principal_point = False
    target.ba_refine_extra_params = False
    target.mapper.abs_pose_refine_focal_length = False
    target.mapper.abs_pose_refine_extra_params = False
    target.num_threads = num_threads
    target.random_seed = random_seed
    return target


def check_options(options: ReconstructorOptions) -> None:
    """Try all options on pycolmap's objects; raises RefractError for a value that it refuses."""
    extraction_options(options, -1)
    matching_options(options, -1)
    pairing_options(options, -1)
    verification_options(options, 0)
    mapping_options(options, -1, 0)


def _set(target: Any, values: dict[str, Any]) -> None:
    """Set options one by one, so that a value which COLMAP refuses is known by its name."""
    with quiet_pycolmap():
        for name, value in values.items():
            try:
                setattr(target, name, value)
                sound = not hasattr(target, "check") or target.check() is not False  # RANSAC's answers None
            except (TypeError, ValueError, RuntimeError):
                sound = False
            if not sound:
                raise RefractError(f"this COLMAP refuses {name} {value!r}; give another value")
