"""Points through waves of known slope deviation: the estimate, its standard deviation, and the command.

Keypoints come from the simulator's least path through a surface tilted at random at its crossing with each ray. What is
not shown here: real waves, whose slopes are alike for near keypoints, and poses or mean planes that are themselves
in error.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from conftest import error_of, snapshot
from scipy.optimize import least_squares, minimize

from colmap_refract.commands.point_triangulator import PointTriangulator
from colmap_refract.estimator.adjustment import SolverSettings, settle_points
from colmap_refract.files.sidecar import ImageInterface, Sidecar, read_sidecar, write_sidecar
from colmap_refract.interface import Array, Layers, tangent_basis
from colmap_refract.mapping.known_views import Views
from colmap_refract.refiner.observations import read_observations
from colmap_refract.simulation import SceneOptions, least_path_direction, simulate
from colmap_refract.triangulator.options import TriangulatorOptions
from colmap_refract.triangulator.outcome import Triangulation
from colmap_refract.triangulator.triangulation import triangulate_points

FOCAL_LENGTH, CENTER = 1200.0, np.array([800.0, 600.0])
NOISE = 0.5
PLAIN = {"loss_function_type": "trivial", "filter_max_error_std": 0.0, "filter_min_tri_angle": 0.0}
"""Options under which nothing but least squares happens."""


@dataclass(frozen=True)
class Waves:
    """A model whose keypoints were taken through waves, its sidecar, and where its points are, by id."""

    model: pycolmap.Reconstruction
    sidecar: Sidecar
    truth: dict[int, Array]

    def triangulate(self, slope_deviation_deg: float, **options: object) -> Triangulation:
        chosen = TriangulatorOptions(slope_deviation_deg=slope_deviation_deg, pixel_noise=NOISE, **options)  # type: ignore[arg-type]
        return triangulate_points(self.model, self.sidecar, chosen)

    def errors(self, result: Triangulation) -> Array:
        return result.points - np.array([self.truth[i] for i in result.point3D_ids.tolist()])


def per_axis(slope_deviation_deg: float) -> float:
    """The two slopes together have the square of the tangent for their mean square."""
    return float(np.tan(np.radians(slope_deviation_deg)) / np.sqrt(2.0))


def tilted(normal: Array, distance: Array | float, crossing: Array, slopes: Array) -> tuple[Array, Array]:
    """Planes (n, 3), (n,) through crossings (n, 3) with slopes (n, 2) over a mean plane."""
    normals = normal + slopes @ tangent_basis(normal).T
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals, np.einsum("ni,ni->n", normals, crossing)


def seen_through_waves(points: Array, normal: Array, distance: float, layers: Layers, slopes: Array) -> Array:
    """Directions in which points (n, 3) are seen, each ray crossing the mean plane where the surface has its slopes."""
    direction = least_path_direction(points, normal, distance, layers)
    for _ in range(15):
        crossing = direction * (distance / (direction @ normal))[:, None]
        direction = least_path_direction(points, *tilted(normal, distance, crossing, slopes), layers)
    return direction


@cache
def waves(
    slope_deviation_deg: float,
    *,
    num_images: int = 10,
    num_points: int = 100,
    shares: tuple[float, ...] = (0.6,),
    noise: float = NOISE,
    wall: float = 0.0,
    dry_images: int = 0,
    seed: int = 0,
) -> Waves:
    """A scene at about 2.5 m; image i has its plane at `shares[i % len]` of the highest point's depth, tilted a little.

    The last `dry_images` look through nothing.
    """
    capture = simulate(
        SceneOptions(
            scenario="moving_interface", num_images=num_images, num_points=num_points, pixel_noise=0.0,
            camera_model="PINHOLE", camera_params=(FOCAL_LENGTH, FOCAL_LENGTH, *CENTER), seed=seed,
        )
    )  # fmt: skip
    rng = np.random.default_rng(1000 + seed)
    layers = Layers(thickness=(wall,), index=(1.5, 1.333)) if wall else Layers()
    model = pycolmap.Reconstruction(capture.reconstruction)
    interfaces = {}
    for i, image_id in enumerate(sorted(model.images)):
        image = model.image(image_id)
        pose = image.cam_from_world()
        seen = [k for k, p in enumerate(image.points2D) if p.has_point3D()]
        ids = [image.point2D(k).point3D_id for k in seen]
        points = np.array([model.point3D(p).xyz for p in ids]) @ pose.rotation.matrix().T + pose.translation
        normal = pose.rotation.matrix() @ [0.0, 0.0, 1.0] + 0.05 * rng.standard_normal(3)
        normal /= np.linalg.norm(normal)
        distance = shares[i % len(shares)] * float((points @ normal).min())
        if i >= num_images - dry_images:
            interfaces[image.name] = ImageInterface(image_id=image_id)
            direction = points
        else:
            interfaces[image.name] = ImageInterface(image_id=image_id, normal_in_cam=tuple(normal), distance=distance)
            slopes = per_axis(slope_deviation_deg) * rng.standard_normal((len(points), 2))
            direction = seen_through_waves(points, normal, distance, layers, slopes)
        pixels = FOCAL_LENGTH * direction[:, :2] / direction[:, 2:] + CENTER
        for k, pixel in zip(seen, pixels + noise * rng.standard_normal(pixels.shape), strict=True):
            image.point2D(k).xy = pixel
    truth = {i: point.xyz.copy() for i, point in model.points3D.items()}
    # Where the model has its points must not matter.
    for point in model.points3D.values():
        point.xyz = point.xyz + 0.05 * rng.standard_normal(3)
    return Waves(model, Sidecar(scenario="moving_interface", layers=layers, images=interfaces), truth)


@dataclass(frozen=True)
class Track:
    """The n observations of one point, with a likelihood of their own: least paths and finite differences.

    Poses (n, 3, 3), (n, 3), planes (n, 3), (n,) and keypoints (n, 2); a distance of 0 where there is no interface.
    """

    rotation: Array
    translation: Array
    normal: Array
    distance: Array
    keypoints: Array
    layers: Layers

    @staticmethod
    def of(scene: Waves, point3D_id: int) -> Track:
        elements = scene.model.point3D(point3D_id).track.elements
        images = [scene.model.image(e.image_id) for e in elements]
        interfaces = [scene.sidecar.images[image.name] for image in images]
        return Track(
            rotation=np.array([image.cam_from_world().rotation.matrix() for image in images]),
            translation=np.array([image.cam_from_world().translation for image in images]),
            normal=np.array([i.normal_in_cam or (0.0, 0.0, 1.0) for i in interfaces]),
            distance=np.array([i.distance or 0.0 for i in interfaces]),
            keypoints=np.array([im.point2D(e.point2D_idx).xy for im, e in zip(images, elements, strict=True)]),
            layers=scene.sidecar.layers,
        )

    def errors(self, point: Array, slopes: tuple[float, float] = (0.0, 0.0)) -> Array:
        """(n, 2) px, in the tangent plane at the keypoint, with the surface tilted by `slopes` at each crossing."""
        in_cam = self.rotation @ point + self.translation
        direction = in_cam / np.linalg.norm(in_cam, axis=1, keepdims=True)
        wet = self.distance > 0
        points, normal, distance = in_cam[wet], self.normal[wet], self.distance[wet]
        seen = least_path_direction(points, normal, distance, self.layers)
        if any(slopes):
            crossing = seen * (distance / np.einsum("ni,ni->n", seen, normal))[:, None]
            normal = normal + np.array([tangent_basis(n) @ slopes for n in normal])
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            seen = least_path_direction(points, normal, np.einsum("ni,ni->n", normal, crossing), self.layers)
        direction[wet] = seen
        x, y = ((self.keypoints - CENTER) / FOCAL_LENGTH).T
        length = np.sqrt(x * x + y * y + 1.0)
        change = length[:, None] * direction - np.column_stack([x, y, np.ones_like(x)])
        # By a pinhole's derivative at the keypoint's direction.
        return FOCAL_LENGTH * (change[:, :2] - change[:, 2:] * np.column_stack([x, y]))

    def covariances(self, point: Array, slope: float) -> Array:
        """(n, 2, 2) of the errors, slopes of deviation `slope` each."""
        step = 1e-5
        by_slope = np.stack(
            [
                (self.errors(point, (a, b)) - self.errors(point, (-a, -b))) / (2 * step)
                for a, b in ((step, 0.0), (0.0, step))
            ],
            axis=2,
        )
        return NOISE**2 * np.eye(2) + slope**2 * by_slope @ by_slope.transpose(0, 2, 1)

    def whitened(self, point: Array, covariances: Array) -> Array:
        lower = np.linalg.cholesky(covariances)
        return np.linalg.solve(lower, self.errors(point)[:, :, None]).ravel()

    def solve(self, start: Array, slope: float) -> tuple[Array, Array]:
        """The point at which weights and least squares agree, and its covariance."""
        point = start
        for _ in range(8):
            covariances = self.covariances(point, slope)
            fit = least_squares(
                lambda x, r=covariances: self.whitened(x, r), point, xtol=1e-13, ftol=1e-14, gtol=1e-12, jac="3-point"
            )
            point = fit.x
        return point, np.linalg.inv(fit.jac.T @ fit.jac)

    def most_likely(self, start: Array, slope: float) -> Array:
        """The point of largest likelihood, with the logarithm of the determinants."""

        def cost(x: Array) -> float:
            covariances = self.covariances(x, slope)
            return float((self.whitened(x, covariances) ** 2).sum() + np.linalg.slogdet(covariances)[1].sum())

        return minimize(cost, start, method="Nelder-Mead", options={"xatol": 1e-5, "fatol": 1e-5}).x


def in_deviations(change: Array, covariance: Array) -> float:
    return float(np.sqrt(change @ np.linalg.solve(covariance, change)))


SCENES: dict[str, Callable[[], Waves]] = {
    "waves": lambda: waves(2.0, num_images=6, shares=(0.2, 0.9)),
    "steep waves": lambda: waves(8.0, num_images=6),
    "dry images": lambda: waves(2.0, num_images=6, dry_images=2),
}


@pytest.mark.parametrize("name", SCENES)
def test_a_point_is_where_its_own_likelihood_says(name: str) -> None:
    scene = SCENES[name]()
    degrees = 8.0 if name == "steep waves" else 2.0
    result = scene.triangulate(degrees, **PLAIN)
    for p in range(0, len(result.points), len(result.points) // 3):
        track = Track.of(scene, int(result.point3D_ids[p]))
        point, covariance = track.solve(result.points[p], per_axis(degrees))
        # Finite differences of 1e-5 in the weights; a wrong weight would move the point by 0.1 and more.
        assert in_deviations(point - result.points[p], covariance) < 1e-3
        np.testing.assert_allclose(result.covariance[p], covariance, rtol=1e-3, atol=1e-4 * np.trace(covariance))


def test_the_likelihood_s_determinants_hardly_move_a_point() -> None:
    """For cameras that move. It is why the simpler equation is solved, and for a fixed camera it is not so."""
    scene = waves(2.0, num_images=8, shares=(0.2, 0.9))
    result = scene.triangulate(2.0, **PLAIN)
    moves = []
    for p in range(0, len(result.points), len(result.points) // 2):
        track = Track.of(scene, int(result.point3D_ids[p]))
        change = track.most_likely(result.points[p], per_axis(2.0)) - result.points[p]
        moves.append(in_deviations(change, result.covariance[p]))
    assert 1e-4 < max(moves) < 0.25


@pytest.mark.parametrize("wall", [0.0, 0.03])
def test_without_waves_it_is_refractive_triangulation(wall: float) -> None:
    scene = waves(0.0, wall=wall)
    result = scene.triangulate(0.0, **PLAIN)
    observations = read_observations(scene.model)
    views = Views(observations, scene.sidecar, 1.0)
    every = np.arange(len(observations.image))
    start, _ = views.triangulated(observations.start, every, settle=False)
    problem = replace(views.problem(observations.start, every, start), loss="trivial")
    expected = settle_points(problem, SolverSettings())
    np.testing.assert_array_equal(result.point3D_ids, observations.point3D_ids)
    # The other solver stops at a ten-millionth of the cost, some thousandths of a standard deviation.
    assert np.abs(result.points - expected).max() < 0.01 * np.median(result.std_across)
    assert np.abs(start - expected).max() > np.abs(result.points - expected).max()


# Variance of standardised errors: 1, give or take four times sqrt(2 / P).
@pytest.mark.parametrize(
    ("degrees", "options"),
    [
        (0.0, {}),
        (2.0, {}),
        (2.0, {"shares": (0.1, 0.5, 0.95)}),
        (2.0, {"dry_images": 3}),
        (6.0, {"shares": (0.3, 0.8)}),
    ],
)
def test_standard_deviations_are_honest(degrees: float, options: dict[str, object]) -> None:
    scene = waves(degrees, num_points=400, **options)  # type: ignore[arg-type]
    result = scene.triangulate(degrees, **PLAIN)
    errors = scene.errors(result)
    limit = 4 * np.sqrt(2 / len(errors))
    assert len(errors) > 380
    np.testing.assert_allclose((errors**2 / np.einsum("pii->pi", result.covariance)).mean(axis=0), 1.0, atol=limit)
    chi_square = np.einsum("pi,pij,pj->p", errors, np.linalg.inv(result.covariance), errors)
    # Of three degrees of freedom: variance 6.
    assert abs(chi_square.mean() / 3 - 1) < 4 * np.sqrt(6 / len(errors)) / 3
    assert abs(result.error_scale - 1) < 0.06
    if degrees:
        # The test can fail: without the waves the deviations are many times too small.
        flat = scene.triangulate(0.0, **PLAIN)
        assert (scene.errors(flat) ** 2 / np.einsum("pii->pi", flat.covariance)).mean() > 5
        assert flat.error_scale > 2 and "larger --slope_deviation_deg" in flat.warnings[0]


def test_what_the_water_spoils_less_counts_for_more() -> None:
    """Images taken close above the points' water, others from far below its level: weights tell them apart."""
    scene = waves(2.0, num_points=400, shares=(0.1, 0.5, 0.95))
    weighted, alike = scene.triangulate(2.0, **PLAIN), scene.triangulate(0.0, **PLAIN)
    rms = [np.sqrt((scene.errors(result) ** 2).sum(axis=1).mean()) for result in (weighted, alike)]
    assert rms[0] < 0.8 * rms[1]
    # The mean of 400 chi-squares is good to a few per cent.
    np.testing.assert_allclose(rms[0], np.sqrt((weighted.std**2).mean()), rtol=0.15)


def test_a_default_loss_and_filter_leave_good_observations_alone() -> None:
    scene = waves(2.0, num_points=400)
    result = scene.triangulate(2.0)
    errors = scene.errors(result)
    # Beyond four deviations in two dimensions: exp(-8) of 4000, and the rounds of filtering.
    assert result.sidecar.statistics["num_filtered_large_error"] <= 10
    assert len(errors) == len(scene.truth)
    ratio = (errors**2 / np.einsum("pii->pi", result.covariance)).mean()
    # The loss costs about two hundredths of the variance, which is not in the deviations.
    assert 0.85 < ratio < 1.2
    assert result.num_restless == 0 and result.warnings == []


def test_wrong_observations_are_removed_and_counted() -> None:
    clean = waves(2.0)
    scene = replace(clean, model=pycolmap.Reconstruction(clean.model))
    rng = np.random.default_rng(7)
    wrong = set()
    for point in scene.model.points3D.values():
        if len(point.track.elements) < 6 or rng.random() < 0.5:
            continue
        element = point.track.elements[int(rng.integers(len(point.track.elements)))]
        keypoint = scene.model.image(element.image_id).point2D(element.point2D_idx)
        keypoint.xy = keypoint.xy + 150.0 * np.array([np.cos(a := rng.uniform(0, 6.28)), np.sin(a)])
        wrong.add((element.image_id, element.point2D_idx))
    assert len(wrong) > 20
    result = scene.triangulate(2.0)
    kept = {(e.image_id, e.point2D_idx) for p in result.reconstruction.points3D.values() for e in p.track.elements}
    before = {(e.image_id, e.point2D_idx) for p in scene.model.points3D.values() for e in p.track.elements}
    assert not kept & wrong
    assert result.sidecar.statistics["num_filtered_large_error"] == len(before - kept) <= len(wrong) + 3
    assert (scene.errors(result) ** 2 / np.einsum("pii->pi", result.covariance)).mean() < 1.4
    # 150 px would not look wrong through waves of 30 degrees.
    assert scene.triangulate(30.0).sidecar.statistics["num_filtered_large_error"] == 0


def test_points_without_parallax_go_or_have_infinite_deviations() -> None:
    """Two images from one place: the rays of a point are one ray."""
    clean = waves(2.0)
    model = pycolmap.Reconstruction(clean.model)
    first, second = sorted(model.images)[:2]
    model.frame(model.image(second).frame_id).rig_from_world = model.image(first).cam_from_world()
    names = [model.image(i).name for i in (first, second)]
    images = dict(clean.sidecar.images)
    images[names[1]] = replace(images[names[0]], image_id=second)
    both = []
    for point3D_id, point in list(model.points3D.items()):
        found = {e.image_id: e.point2D_idx for e in point.track.elements}
        if not {first, second} <= found.keys() or len(both) == 5:
            continue
        for image_id, idx in found.items():
            if image_id not in (first, second):
                model.delete_observation(image_id, idx)
        model.image(second).point2D(found[second]).xy = model.image(first).point2D(found[first]).xy
        both.append(point3D_id)
    # The other points had the second image where it was.
    for point3D_id in list(model.points3D):
        if point3D_id not in both:
            track = [(e.image_id, e.point2D_idx) for e in model.point3D(point3D_id).track.elements]
            for element in track:
                if element[0] == second:
                    model.delete_observation(*element)
    scene = replace(clean, model=model, sidecar=replace(clean.sidecar, images=images))
    assert len(both) == 5
    result = scene.triangulate(2.0)
    assert not set(both) & set(result.reconstruction.points3D)
    assert result.sidecar.statistics["num_filtered_small_angle"] == 5
    everything = scene.triangulate(2.0, filter_min_tri_angle=0.0)
    deviation = dict(zip(everything.point3D_ids.tolist(), everything.std.tolist(), strict=True))
    assert min(deviation[i] for i in both) > 1e3 * np.median(everything.std)


def write(scene: Waves, folder: Path) -> Path:
    folder.mkdir()
    scene.model.write(folder)
    write_sidecar(scene.sidecar, folder / "refraction.json")
    return folder


def command(input_path: Path, output_path: Path, degrees: float = 2.0, **fields: object) -> PointTriangulator:
    options = TriangulatorOptions(slope_deviation_deg=degrees)
    return PointTriangulator(input_path=input_path, output_path=output_path, options=options, **fields)  # type: ignore[arg-type]


def test_the_command_writes_model_sidecar_and_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = waves(2.0)
    source = write(scene, tmp_path / "in")
    before = snapshot(source)
    command(source, tmp_path / "out").run()
    printed = capsys.readouterr()
    assert snapshot(source) == before
    assert printed.err == ""
    assert "2 deg" in printed.out and "[model units]" in printed.out and "along the view" in printed.out
    model = pycolmap.Reconstruction(tmp_path / "out")
    assert set(model.points3D) == set(scene.model.points3D)
    for image_id, image in scene.model.images.items():
        written = model.image(image_id)
        assert written.name == image.name
        np.testing.assert_array_equal([p.xy for p in written.points2D], [p.xy for p in image.points2D])
        np.testing.assert_array_equal(written.cam_from_world().matrix(), image.cam_from_world().matrix())
    sidecar = read_sidecar(tmp_path / "out")
    assert sidecar.images == scene.sidecar.images and sidecar.layers == scene.sidecar.layers
    assert sidecar.statistics["num_observations"] == model.compute_num_observations()
    assert sidecar.options["point_triangulator"]["slope_deviation_deg"] == 2.0
    with (tmp_path / "out" / "point_std.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["point3D_id"]) for row in rows] == sorted(model.points3D)
    for row in rows:
        point = model.point3D(int(row["point3D_id"]))
        np.testing.assert_array_equal([float(row[c]) for c in "xyz"], point.xyz)
        per_axis = np.array([float(row[f"std_{c}"]) for c in "xyz"])
        assert float(row["std"]) == pytest.approx(np.linalg.norm(per_axis), rel=1e-5)
        assert int(row["num_observations"]) == point.track.length()
        assert float(row["reprojection_error"]) == pytest.approx(point.error, rel=1e-5)
    # Again, over it, and nothing else stays behind.
    command(source, tmp_path / "out", overwrite=True).run()
    assert "point_std.csv" in snapshot(tmp_path / "out")


def test_the_input_is_not_altered_in_memory() -> None:
    scene = waves(2.0)
    before = {i: p.xyz.copy() for i, p in scene.model.points3D.items()}
    result = scene.triangulate(2.0)
    assert all((scene.model.point3D(i).xyz == xyz).all() for i, xyz in before.items())
    assert any((result.reconstruction.point3D(i).xyz != before[i]).any() for i in result.reconstruction.points3D)


def test_bad_input_is_one_line_and_leaves_nothing(tmp_path: Path) -> None:
    scene = waves(2.0)
    source, out = write(scene, tmp_path / "in"), tmp_path / "out"
    assert "is the input" in error_of(command(source, source).run)

    bare = tmp_path / "bare"
    bare.mkdir()
    scene.model.write(bare)
    assert "--sidecar_path" in error_of(command(bare, out).run)
    assert "does not exist" in error_of(command(bare, out, sidecar_path=tmp_path / "none.json").run)

    name = sorted(scene.sidecar.images)[0]
    images = {n: i for n, i in scene.sidecar.images.items() if n != name}
    write_sidecar(replace(scene.sidecar, images=images), bare / "refraction.json")
    assert name in error_of(command(bare, out).run)

    walls = replace(scene.sidecar, layers=Layers(thickness=(0.01,), index=(1.5, 1.333)))
    write_sidecar(walls, bare / "refraction.json")
    assert "--slope_deviation_deg 0" in error_of(command(bare, out).run)

    strict = TriangulatorOptions(slope_deviation_deg=2.0, filter_min_tri_angle=170.0)
    assert "filtered" in error_of(PointTriangulator(input_path=source, output_path=out, options=strict).run)
    assert not out.exists()

    command(bare, out, sidecar_path=source / "refraction.json").run()
    assert (out / "points3D.bin").is_file()


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("slope_deviation_deg", -1.0), ("slope_deviation_deg", 45.0), ("slope_deviation_deg", float("nan")),
        ("pixel_noise", 0.0), ("pixel_noise", -0.5), ("pixel_noise", float("inf")), ("loss_function_scale", 0.0),
        ("filter_max_error_std", -1.0), ("filter_min_tri_angle", float("nan")),
    ],
)  # fmt: skip
def test_impossible_options_are_refused(field: str, value: float) -> None:
    fields = {"slope_deviation_deg": 2.0, field: value}
    assert field in error_of(lambda: TriangulatorOptions(**fields))  # type: ignore[arg-type]
