"""Whether the views show enough to trust a calibration: how much of the image they cover, how the board was tilted."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_refract.calibration.calibration import Calibration
from colmap_refract.calibration.precision import image_std
from colmap_refract.interface import Array

CORNER_NAMES = ("top-left", "top-right", "bottom-left", "bottom-right")

_BARE_CORNER = 0.25  # a gap of this size is worth a word
_RASTER = 320  # cells along the longer side
_GRID = 9  # places along each side at which the precision is computed


@dataclass(frozen=True, kw_only=True)
class Coverage:
    """How the views cover the image.

    Attributes:
        counts: (h, w) number of views with the board there (inside the hull of its corners), on a raster of the image.
        area: share of the image with the board in at least one view.
        corner_gaps: how far the board stayed from each corner of the image, in the order of `CORNER_NAMES`, as a share
            of half the diagonal: 0 is covered, 1 has the board no nearer than the middle.
        tilt: largest angle between the board's directions in two views, degrees.
        distances: of the board's middle in the nearest and the farthest view, squares.
        places: (K, 2) pixels on a grid over the image.
        image_std: (K,) standard deviation of where the camera sees a given direction, at `places`, px.
    """

    counts: NDArray[np.int64]
    area: float
    corner_gaps: Array
    tilt: float
    distances: tuple[float, float]
    places: Array
    image_std: Array


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What is to be said about a calibration, each a sentence that says what to do.

    Attributes:
        warnings: why it should not be trusted.
        advice: what would make it better.
    """

    warnings: tuple[str, ...]
    advice: tuple[str, ...]


def measure_coverage(calibration: Calibration, corners: Array) -> Coverage:
    """Measure the coverage of the views that were kept.

    Args:
        calibration: of at least one view.
        corners: (N, 3) of the board, squares.
    """
    camera = calibration.camera
    size = np.array([camera.width, camera.height])
    cells = np.maximum(1, np.round(_RASTER * size / size.max())).astype(int)
    counts = np.zeros(cells[::-1], np.int64)
    for fit in calibration.kept:
        hull = cv2.convexHull((fit.view.xy * cells / size).astype(np.float32))
        inside = np.zeros(counts.shape, np.uint8)
        cv2.fillConvexPoly(inside, np.floor(hull).astype(np.int32), 1)
        counts += inside
    # Cells in units of half the diagonal; the raster's cells are square but for rounding.
    empty_distance = cv2.distanceTransform((counts == 0).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    gaps = empty_distance[[0, 0, -1, -1], [0, -1, 0, -1]] / (np.linalg.norm(cells) / 2)
    middle = corners.mean(axis=0)
    distances = [
        float(np.linalg.norm(fit.pose[0] @ middle + fit.pose[1])) for fit in calibration.kept if fit.pose is not None
    ]
    steps = (np.arange(_GRID) + 0.5) / _GRID
    steps = (steps - 0.5) * (_GRID / (_GRID - 1)) + 0.5  # from edge to edge
    places = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) * size
    return Coverage(
        counts=counts,
        area=float(np.mean(counts > 0)),
        corner_gaps=np.asarray(gaps, np.float64),
        tilt=calibration.tilt,
        distances=(min(distances), max(distances)),
        places=places,
        image_std=image_std(camera, calibration.covariance, places),
    )


def judge(calibration: Calibration, coverage: Coverage) -> Verdict:
    """Say whether a calibration can be trusted, and what would make it better."""
    warnings: list[str] = []
    advice: list[str] = []

    def say(value: float, worth_saying: float, too_bad: float, sentence: str) -> None:
        """Larger values are worse."""
        if not value <= too_bad:
            warnings.append(sentence)
        elif value > worth_saying:
            advice.append(sentence)

    num_kept = len(calibration.kept)
    num_found = sum(len(fit.view.corner_idxs) > 0 for fit in calibration.views)
    num_images, num_dropped = len(calibration.views), num_found - num_kept
    say(-num_kept, -10, -6, f"Only {num_kept} views were used: take 10 to 20.")
    say(
        -num_found / num_images, -0.6, -0.1,
        f"The board was found in {num_found} of {num_images} images only: use sharp, evenly lit ones of all of it.",
    )  # fmt: skip
    say(
        num_dropped / num_found, 0.2, 0.4,
        f"{num_dropped} of {num_found} views were dropped: look at them, the board may not be flat, the "
        "pictures blurred, or the focus not fixed.",
    )  # fmt: skip
    say(
        -coverage.area, -0.75, -0.5,
        f"The board covers only {100 * coverage.area:.0f} % of the image: take pictures with it in the other parts.",
    )  # fmt: skip
    gaps = coverage.corner_gaps
    bare = [name for name, gap in zip(CORNER_NAMES, gaps, strict=True) if gap > _BARE_CORNER]
    say(
        gaps.max(), _BARE_CORNER, 0.45,
        f"The board was never near the {_listed(bare)} of the image: the distortion there is extrapolated; bring it "
        "there, unless the lens leaves that part dark.",
    )  # fmt: skip
    say(
        -coverage.tilt, -35.0, -20.0,
        f"The board's directions differ by {coverage.tilt:.0f} degrees at most: tilt it by 20 to 40 degrees to "
        "different sides, or focal length and distance are hard to tell apart.",
    )  # fmt: skip
    focal = list(calibration.camera.focal_length_idxs())
    share = float(np.max(calibration.std[focal] / np.abs(np.asarray(calibration.camera.params)[focal])))
    say(share, 0.002, 0.005, f"The focal length is only known to {100 * share:.2g} %: take more views, tilted more.")
    worst = float(coverage.image_std.max())
    if np.isinf(worst):
        warnings.append(
            "The distortion cannot be inverted everywhere in the image: bring the board to the parts that are not "
            "covered, or take a camera_model with fewer parameters."
        )
    else:
        say(
            worst, 0.3, 1.0,
            f"Somewhere in the image directions are only good to {worst:.2g} px: take more views, and cover it.",
        )  # fmt: skip
    say(
        calibration.noise, 0.5, 1.0,
        f"The corners fit to {calibration.noise:.2g} px only, 0.1 to 0.5 px is usual: take sharp pictures of a flat "
        "board, and a camera_model with enough parameters.",
    )  # fmt: skip
    say(
        calibration.correlation, 0.3, 0.5,
        f"The errors of neighbouring corners are alike (correlation {calibration.correlation:.2f}), so that the "
        "standard deviations are too small: use a flat board, or a camera_model with more parameters.",
    )  # fmt: skip
    return Verdict(warnings=tuple(warnings), advice=tuple(advice))


def _listed(corners: list[str]) -> str:
    if len(corners) in (0, 4):
        return "corners"
    if len(corners) == 1:
        return f"{corners[0]} corner"
    return f"{', '.join(corners[:-1])} and {corners[-1]} corners"
