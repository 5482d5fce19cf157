"""Real photographs' tracks and residuals, outliers included, with pixels that were put under water.

The models lie in `shared/data` beside the checkout; without them there is nothing to test.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from colmap_refract.interface import Array
from colmap_refract.options import RefinerOptions, Scenario
from colmap_refract.refiner.refinement import Refinement, refine

DATA = Path(__file__).parents[2] / "shared" / "data"
SCENARIOS: tuple[Scenario, ...] = ("static_interface", "moving_interface", "camera_housing")

pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason=f"no models in {DATA}")


@dataclass(frozen=True)
class RealModel:
    """A model that ignored refraction, its truth, and what the refiner makes of it."""

    scenario: Scenario
    model: pycolmap.Reconstruction
    truth: dict[str, Any]
    refined: Refinement


@pytest.fixture(scope="module", params=SCENARIOS)
def real(request: pytest.FixtureRequest) -> RealModel:
    scenario: Scenario = request.param
    folder = DATA / f"lund_door_{scenario}"
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    with np.load(folder / "truth.npz") as truth:
        return RealModel(scenario, model, dict(truth), refine(model, RefinerOptions(scenario=scenario)))


def similarity(source: Array, target: Array) -> pycolmap.Sim3d:
    """The one that brings `source` to the best nine tenths of `target`: single points run away."""
    best = np.argsort(np.linalg.norm(source - np.median(source, axis=0), axis=1))
    for _ in range(20):
        best = best[: int(0.9 * len(source))]
        found = pycolmap.estimate_sim3d(source[best], target[best])
        assert found is not None
        best = np.argsort(np.linalg.norm(found * source - target, axis=1))
    return found


def median_depth(truth: dict[str, Any], model: pycolmap.Reconstruction) -> float:
    """Of the true points before the cameras that see them, in the truth's units."""
    row = {int(point3D_id): k for k, point3D_id in enumerate(truth["point3D_ids"])}
    depths = []
    for name, pose in zip(truth["names"], truth["cam_from_world"], strict=True):
        image = model.find_image_with_name(str(name))
        assert image is not None
        seen = [row[point2D.point3D_id] for point2D in image.get_observation_points2D()]
        depths.append(truth["points"][seen] @ pose[2, :3] + pose[2, 3])
    return float(np.median(np.concatenate(depths)))


def median_error(model: pycolmap.Reconstruction, truth: dict[str, Any]) -> float:
    """Median distance of the points to the truth after alignment, in the truth's units."""
    kept = [k for k, i in enumerate(truth["point3D_ids"]) if model.exists_point3D(int(i))]
    found = np.array([model.point3D(int(truth["point3D_ids"][k])).xyz for k in kept])
    target = truth["points"][kept]
    return float(np.median(np.linalg.norm(similarity(found, target) * found - target, axis=1)))


# In units of the median depth, over all points; somewhat above what the refiner reaches (1.28e-4, 1.28e-4, 0.84e-4).
LARGEST_ERROR = {"static_interface": 1.4e-4, "moving_interface": 1.4e-4, "camera_housing": 1.0e-4}


def test_points_come_out_right(real: RealModel) -> None:
    after = real.refined.reconstruction
    assert real.refined.converged
    depth = median_depth(real.truth, real.model)
    assert median_error(after, real.truth) < LARGEST_ERROR[real.scenario] * depth
    # Ignoring refraction it was forty times that and more.
    assert median_error(real.model, real.truth) > 40 * LARGEST_ERROR[real.scenario] * depth
    assert after.num_points3D() > 0.97 * real.model.num_points3D()
    assert after.compute_num_observations() > 0.97 * real.model.compute_num_observations()


def test_planes_come_out_right(real: RealModel) -> None:
    """By tenths of a degree and a per cent of the depth: the scene's own residuals are some tenths of a pixel."""
    after = real.refined.reconstruction
    kept = [k for k, i in enumerate(real.truth["point3D_ids"]) if after.exists_point3D(int(i))]
    found = np.array([after.point3D(int(real.truth["point3D_ids"][k])).xyz for k in kept])
    scale = similarity(found, real.truth["points"][kept]).scale
    depth = median_depth(real.truth, real.model)
    for name, (*normal, distance) in zip(real.truth["names"], real.truth["planes"], strict=True):
        entry = real.refined.sidecar.images[str(name)]
        assert entry.normal_in_cam is not None and entry.distance is not None
        assert np.degrees(2 * np.arcsin(0.5 * np.linalg.norm(np.subtract(entry.normal_in_cam, normal)))) < 0.5
        assert abs(scale * entry.distance - distance) < 0.01 * depth


@pytest.mark.parametrize("which", [0, 1], ids=["near", "far"])
def test_starts_end_at_the_same_minimum(real: RealModel, which: int) -> None:
    """Of the depth: a fifth and four fifths; for the port, at 0.012, half of that and four times as much."""
    ratio = {"camera_housing": (0.006, 0.048)}.get(real.scenario, (0.2, 0.8))[which]
    result = refine(real.model, RefinerOptions(scenario=real.scenario, initial_distance_ratio=ratio))
    assert result.converged
    assert result.sidecar.solver["cost"] == pytest.approx(real.refined.sidecar.solver["cost"], rel=1e-3)
    assert result.sidecar.statistics["num_points3D"] == pytest.approx(
        real.refined.sidecar.statistics["num_points3D"], rel=1e-3
    )
