"""Dense points of rendered captures, against the ground that the simulator rendered.

Poses and interfaces are the true ones, so that what is seen is the error of matching and triangulation alone; what
the refiner's errors add is not shown here. Nor are caustics, reflections or moving things.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from conftest import error_of, snapshot
from numpy.typing import NDArray

from colmap_refract.cli import main
from colmap_refract.dense.grid import Grid
from colmap_refract.dense.known_images import KnownImages
from colmap_refract.dense.matching import local_correlation, predict
from colmap_refract.dense.meshing import poisson_mesh
from colmap_refract.dense.neighbourhood import near_median, normals
from colmap_refract.dense.options import DenseOptions, PoissonMeshingOptions
from colmap_refract.dense.reconstruction import DenseView, reconstruct
from colmap_refract.dense.triangulation import triangulate
from colmap_refract.files.model_io import write_model
from colmap_refract.files.point_cloud import read_point_cloud, write_point_cloud
from colmap_refract.files.sidecar import SIDECAR_NAME, ImageInterface, Sidecar, write_sidecar
from colmap_refract.interface import Array
from colmap_refract.optical_flow.field import fit_field
from colmap_refract.options import Scenario
from colmap_refract.photographs.images import read_gray, read_rgb
from colmap_refract.simulation import SceneOptions
from colmap_refract.simulation.session import SessionOptions, photograph, write_session
from colmap_refract.simulation.surface import Wave
from colmap_refract.simulation.truth import Truth
from colmap_refract.water_surface import sampled

WIDTH, HEIGHT, FOCAL = 320, 240, 256.0
OPTIONS = DenseOptions(step=3)
VERTEX = np.dtype([(n, "<f4") for n in ("x", "y", "z", "nx", "ny", "nz")] + [(n, "u1") for n in ("r", "g", "b")])


@dataclass(frozen=True)
class Workspace:
    """A rendered capture in a folder, with the true geometry as a refined model."""

    folder: Path
    truth: Truth
    model: pycolmap.Reconstruction
    sidecar: Sidecar

    def reconstruct(self, options: DenseOptions = OPTIONS) -> list[DenseView]:
        images = self.folder / "images"
        return reconstruct(
            self.model,
            self.sidecar,
            lambda name: read_gray(images / name),
            lambda name: read_rgb(images / name),
            options,
        )

    def off(self, points: Array) -> Array:
        """Signed distances (n,) from the ground over the median distance from the first camera."""
        terrain = self.truth.terrain
        slope = terrain.gradient(points[:, :2])
        away = (points[:, 2] - terrain.height(points[:, :2])) / np.sqrt(1 + (slope**2).sum(axis=1))
        return np.asarray(away / np.median(np.linalg.norm(points - self.truth.views[0].center, axis=1)))

    def normals(self, points: Array) -> Array:
        """Of the ground (n, 3), upwards: the world's z is down."""
        slope = self.truth.terrain.gradient(points[:, :2])
        up = np.column_stack([slope, -np.ones(len(points))])
        return np.asarray(up / np.linalg.norm(up, axis=1, keepdims=True))


def true_model(truth: Truth, seed: int) -> tuple[pycolmap.Reconstruction, Sidecar]:
    """A model of points strewn over the ground, as exact as COLMAP's files are."""
    rng = np.random.default_rng(seed)
    size = np.array([WIDTH, HEIGHT])
    strewn = np.concatenate([truth.trace(name, rng.uniform(0, size, (40, 2))) for name in truth.names])
    strewn = strewn[np.isfinite(strewn).all(axis=1)]
    model = pycolmap.Reconstruction()
    for camera in truth.cameras.values():
        model.add_camera_with_trivial_rig(camera)
    tracks = [pycolmap.Track() for _ in strewn]
    for i, (name, view) in enumerate(zip(truth.names, truth.views, strict=True)):
        pixels = truth.project(name, strewn)
        rows = np.flatnonzero(((pixels > 0) & (pixels < size)).all(axis=1))
        for k, row in enumerate(rows.tolist()):
            tracks[row].add_element(i + 1, k)
        image = pycolmap.Image(name=name, keypoints=pixels[rows], camera_id=view.camera.camera_id, image_id=i + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(view.cam_from_world))
    for point, track in zip(strewn, tracks, strict=True):
        if track.length() >= 2:
            model.add_point3D(point, track, np.zeros(3, np.uint8))
    interfaces = {
        name: ImageInterface(
            image_id=i + 1, normal_in_cam=tuple(plane[:3] / np.linalg.norm(plane[:3])), distance=float(plane[3])
        )
        for i, (name, plane) in enumerate(zip(truth.names, truth.planes, strict=True))
    }
    layers = truth.views[0].surface.layers
    return model, Sidecar(scenario=truth.scenario, layers=layers, images=interfaces)


def make(folder: Path, scenario: Scenario) -> Workspace:
    scene = SceneOptions(
        scenario=scenario, num_images=6, width=WIDTH, height=HEIGHT, focal_length=FOCAL, oblique_deg=10.0, seed=3
    )
    session = photograph(SessionOptions(scene=scene, jpeg_quality=95))
    write_session(session, folder)
    model, sidecar = true_model(session.truth, seed=5)
    sparse = folder / "sparse_refractive" / "0"
    sparse.mkdir(parents=True)
    write_model(model, sparse)
    write_sidecar(sidecar, sparse / SIDECAR_NAME)
    return Workspace(folder, session.truth, model, sidecar)


@pytest.fixture(scope="module")
def moving(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    return make(tmp_path_factory.mktemp("moving"), "static_interface")


@pytest.fixture(scope="module")
def fixed(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    return make(tmp_path_factory.mktemp("fixed"), "fixed_camera")


@pytest.fixture(scope="module")
def dense(moving: Workspace, fixed: Workspace) -> dict[str, tuple[Workspace, list[DenseView]]]:
    return {"moving": (moving, moving.reconstruct()), "fixed": (fixed, fixed.reconstruct())}


# Medians and 95 % of the distance from the ground over depth. A match is good to 0.05 px, 2e-4 of the depth at this
# focal length, and squares of 15 px flatten boulders a little more. The rays of the fixed camera meet at two degrees in
# place of thirty.
LIMITS = {"moving": (6e-4, 2.5e-3), "fixed": (2e-3, 8e-3)}


@pytest.mark.parametrize("capture", LIMITS)
def test_points_lie_on_the_ground(dense: dict[str, tuple[Workspace, list[DenseView]]], capture: str) -> None:
    workspace, (view,) = dense[capture]
    off = workspace.off(view.points)
    median, most = LIMITS[capture]
    assert np.median(np.abs(off)) < median
    assert np.quantile(np.abs(off), 0.95) < most
    # On average neither above nor below it.
    assert abs(np.median(off)) < 0.3 * median
    assert view.coverage > 0.85
    removed = view.num_unmatched + view.num_large_error + view.num_small_angle + view.num_far_off
    assert view.num_covered == 0 and len(view.points) + removed == view.num_nodes == view.depth.size


def test_large_images_are_matched_in_copies(moving: Workspace) -> None:
    (view,) = moving.reconstruct(replace(OPTIONS, max_image_size=199, step=2))
    # 199 by 149: the two ratios differ.
    assert view.picture.shape == (149, 199, 3)
    assert np.median(np.abs(moving.off(view.points))) < 2 * LIMITS["moving"][0]
    assert abs(np.median(moving.off(view.points))) < 0.3 * LIMITS["moving"][0]


@pytest.mark.parametrize("capture", LIMITS)
def test_normals_point_up_from_the_ground(dense: dict[str, tuple[Workspace, list[DenseView]]], capture: str) -> None:
    workspace, (view,) = dense[capture]
    np.testing.assert_allclose(np.linalg.norm(view.normals, axis=1), 1)
    cosine = np.einsum("ni,ni->n", view.normals, workspace.normals(view.points))
    assert (cosine > 0).all()
    # Degrees: over 7 nodes of 3 px each the ground bends, and the points are noisy.
    assert np.degrees(np.arccos(np.median(cosine))) < (4 if capture == "moving" else 15)


@pytest.mark.parametrize("capture", LIMITS)
def test_colours_are_those_of_the_picture(dense: dict[str, tuple[Workspace, list[DenseView]]], capture: str) -> None:
    workspace, (view,) = dense[capture]
    pixels = workspace.truth.project(view.name, view.points)
    picture = read_rgb(workspace.folder / "images" / view.name)
    column, row = np.clip(np.floor(pixels).astype(int), 0, [WIDTH - 1, HEIGHT - 1]).T
    there, elsewhere = (
        np.abs(picture[row, c].astype(int) - view.colours).mean() for c in (column, (column + 20) % WIDTH)
    )
    # A pixel beside the right one is allowed, where a point is off by that; another place is not.
    assert there < 0.2 * elsewhere
    assert np.abs(picture[row, column].astype(int) - view.colours[:, ::-1]).mean() > 2 * there, "red is not blue"


def test_further_references_add_what_is_missing(moving: Workspace) -> None:
    first, second = moving.reconstruct(replace(OPTIONS, num_references=2, step=4))
    assert first.name != second.name and second.num_covered > 0
    assert np.quantile(np.abs(moving.off(second.points)), 0.9) < 2e-3
    # Few nodes of the second are where the first has points: seen from the second, those are a node away.
    seen = moving.truth.project(second.name, first.points)
    new = moving.truth.project(second.name, second.points)
    near = np.linalg.norm(new[:, None] - seen[None, :: max(1, len(seen) // 2000)], axis=2).min(axis=1)
    assert np.quantile(near, 0.1) > 1.0


def test_a_reference_can_be_named_and_wrong_geometry_leaves_nothing(moving: Workspace) -> None:
    name = moving.truth.names[-1]
    (view,) = moving.reconstruct(replace(OPTIONS, reference_image=name, step=6))
    assert view.name == name and name not in view.neighbours
    planes = {key: replace(one, distance=0.3 * (one.distance or 1.0)) for key, one in moving.sidecar.images.items()}
    wrong = replace(moving, sidecar=replace(moving.sidecar, images=planes))
    (bent,) = wrong.reconstruct(replace(OPTIONS, reference_image=name, step=6, max_reproj_error=5.0))
    assert np.median(np.abs(moving.off(bent.points))) > 20 * np.median(np.abs(moving.off(view.points)))
    assert np.median(bent.errors) > 3 * np.median(view.errors)


def test_rays_through_waves_meet_where_the_ground_is() -> None:
    """Exact pixels of a capture with waves, whose surfaces are given as the refiner writes them."""
    scene = SceneOptions(scenario="fixed_camera", num_images=6, width=WIDTH, height=HEIGHT, focal_length=FOCAL, seed=4)
    wave = Wave(wavelength=1.5, amplitude=0.0125, direction_deg=30.0, phase_deg=20.0)
    truth = photograph(SessionOptions(scene=scene, waves=(wave,))).truth
    model, sidecar = true_model(truth, seed=1)
    images = {}
    for name, view in zip(truth.names, truth.views, strict=True):
        interface = sidecar.images[name]
        normal = np.array(interface.normal_in_cam)
        turn, shift = view.cam_from_world[:, :3], view.cam_from_world[:, 3]
        axes = np.linalg.svd(normal[None])[2][1:].T
        corners = np.array([[x, y] for x in (0.0, WIDTH) for y in (0.0, HEIGHT)])
        rays = np.asarray(view.camera.cam_ray_from_img(corners))
        places = (interface.distance or 0) / (rays @ normal)[:, None] * (rays @ axes)

        def heights(at: Array, view=view, turn=turn, shift=shift, axes=axes, normal=normal, interface=interface):  # type: ignore
            flat = (at @ axes.T + interface.distance * normal - shift) @ turn
            # How deep the plane lies below the waves there, along the plane's normal to first order.
            return -view.surface.depth_below(flat)

        surface = sampled(heights, places, axes=axes, correlation_length=1.5 / (np.sqrt(2) * np.pi))
        images[name] = replace(interface, surface=surface)
    nodes = np.random.default_rng(0).uniform([40, 40], [WIDTH - 40, HEIGHT - 40], (300, 2))
    true = truth.trace(truth.names[0], nodes)
    pixels = np.array([nodes, *(truth.project(name, true) for name in truth.names[1:])])
    found = {}
    for key, entries in (("waves", images), ("planes", sidecar.images)):
        known = KnownImages(model, replace(sidecar, images=entries))
        found[key] = triangulate(known, range(6), pixels, 5.0)
    off = {key: np.linalg.norm(one.points - true, axis=1) for key, one in found.items()}
    assert np.nanmedian(off["waves"]) < 0.05 * np.nanmedian(off["planes"])
    assert np.nanmedian(found["waves"].errors) < 0.02


def test_wrong_matches_and_points_before_the_water(moving: Workspace) -> None:
    known = KnownImages(moving.model, moving.sidecar)
    truth, rng = moving.truth, np.random.default_rng(2)
    ground = truth.trace(truth.names[0], rng.uniform([60, 60], [WIDTH - 60, HEIGHT - 60], (200, 2)))
    # A third of them as high above the water as they are below it.
    surface = truth.views[0].surface
    dry = np.arange(len(ground)) % 3 == 0
    ground[dry] -= (1.2 * surface.depth_below(ground[dry]))[:, None] * surface.normal
    pixels = np.array([truth.project(name, ground) for name in truth.names])
    wrong = rng.integers(1, 6, len(ground))
    pixels[wrong, np.arange(len(ground))] += rng.choice([-1, 1], (len(ground), 2)) * rng.uniform(
        8, 30, (len(ground), 2)
    )
    dense = triangulate(known, range(6), pixels, 1.0)
    good = np.linalg.norm(dense.points - ground, axis=1) < 1e-3
    assert good[dry].mean() > 0.9 and good[~dry].mean() > 0.9
    assert (dense.num_views[good] == 5).all() and (dense.num_matched == 6).all()
    assert dense.errors[good].max() < 0.05


def test_depth_far_off_its_neighbours_goes_and_normals_are_those_of_a_plane() -> None:
    rows, columns = np.mgrid[0:30, 0:40]
    depth = 2 + 0.01 * rows + 0.02 * columns
    depth[10, 10], depth[20, 5] = 2.6, 1.0
    depth[:, 30:] = np.nan
    depth[4, 36] = 2.0  # alone
    near = near_median(depth, 0.05)
    expected = np.isfinite(depth)
    expected[10, 10] = expected[20, 5] = expected[4, 36] = False
    assert (near == expected).all()
    points = np.dstack([columns, rows, np.where(near, depth, np.nan)]).astype(float)
    points[~near] = np.nan
    facing = normals(points, np.broadcast_to([0.0, 0.0, 1.0], points.shape))
    normal = np.array([0.02, 0.01, -1]) / np.linalg.norm([0.02, 0.01, -1])
    assert (np.isfinite(facing[..., 0]) == near).all()
    np.testing.assert_allclose(facing[near], np.broadcast_to(normal, facing[near].shape), atol=1e-9)


def test_fields_keep_what_a_turned_camera_sees_straight() -> None:
    """A quarter turn moves neighbouring pixels by more than a pixel: OpenCV's cubic interpolation erred by 0.5 px."""
    places = np.random.default_rng(0).uniform(0, [WIDTH, HEIGHT], (400, 2))
    turn = np.array([[0.0, -1.2], [1.1, 0.0]])
    moved = places @ (turn - np.eye(2)).T
    at = np.random.default_rng(1).uniform(30, [WIDTH - 30, HEIGHT - 30], (500, 2))
    field = fit_field(places, moved, (HEIGHT, WIDTH), spacing=12)
    assert np.median(np.abs(field.at(at) - at @ (turn - np.eye(2)).T)) < 0.03
    # Where points are on one side only the field is stiff; not so what is predicted.
    at = np.random.default_rng(1).uniform(0, [WIDTH - 1, HEIGHT - 1], (500, 2))
    predicted = predict(places, places + moved, WIDTH, HEIGHT)
    assert predicted is not None
    assert np.abs(predicted.at(at) - at @ (turn - np.eye(2)).T).max() < 0.001
    assert predict(places[:14], places[:14] + moved[:14], WIDTH, HEIGHT) is None
    grid = Grid(width=WIDTH, height=HEIGHT, step=3, margin=8)
    again = grid.field(field.at(grid.nodes))
    assert np.abs(again.at(grid.nodes) - field.at(grid.nodes)).max() < 1e-3


def test_correlation_is_numpys() -> None:
    rng = np.random.default_rng(0)
    a = rng.integers(0, 255, (40, 50)).astype(np.uint8)
    b = (0.5 * a + 0.5 * rng.integers(0, 255, a.shape)).astype(np.uint8)
    got = local_correlation(a, b, 4)[20, 30]
    assert got == pytest.approx(np.corrcoef(a[16:25, 26:35].ravel(), b[16:25, 26:35].ravel())[0, 1], abs=1e-4)
    assert local_correlation(np.full_like(a, 7), b, 4).max() == 0


def vertices(path: Path) -> NDArray[np.void]:
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode().split("\n")
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    names = [line.split()[2] for line in lines if line.startswith("property")]
    assert names == ["x", "y", "z", "nx", "ny", "nz", "red", "green", "blue"]
    (count,) = (int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    assert len(body) == count * VERTEX.itemsize
    return np.frombuffer(body, VERTEX)


def test_commands_from_images_to_mesh(moving: Workspace, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = snapshot(moving.folder)
    sparse, images, out = moving.folder / "sparse_refractive/0", moving.folder / "images", tmp_path / "dense"
    arguments = ["--input_path", str(sparse), "--image_path", str(images), "--output_path", str(out), "--step", "4"]
    assert main(["dense_reconstructor", *arguments]) == 0
    printed = capsys.readouterr().out
    assert sorted(snapshot(out)) == ["dense_report.txt", "depth_maps.png", "fused.ply"]
    cloud = vertices(out / "fused.ply")
    xyz = np.column_stack([cloud[axis] for axis in "xyz"]).astype(float)
    assert np.median(np.abs(moving.off(xyz))) < LIMITS["moving"][0]
    assert str(len(cloud)) in printed and "% of the grid covered" in printed
    page = read_rgb(out / "depth_maps.png")
    assert page.shape[0] > HEIGHT and page.shape[1] > 2 * WIDTH and len(np.unique(page.reshape(-1, 3), axis=0)) > 1000

    mesh = out / "meshed-poisson.ply"
    mesher = ["poisson_mesher", "--input_path", str(out / "fused.ply"), "--output_path", str(mesh)]
    assert main(mesher) == 0
    assert main(mesher) == 1
    assert "exists already" in capsys.readouterr().err
    head, _, body = mesh.read_bytes().partition(b"end_header\n")
    count = int(head.split(b"element vertex ")[1].split()[0])
    vertex = np.dtype([(n, "<f4") for n in ("x", "y", "z", "value")] + [(n, "u1") for n in "rgb"])
    corners = np.frombuffer(body, vertex, count)
    xyz = np.column_stack([corners[axis] for axis in "xyz"]).astype(float)
    # About the edge the mesh goes on beyond the points.
    assert np.quantile(np.abs(moving.off(xyz)), 0.8) < 2e-3
    assert int(head.split(b"element face ")[1].split()[0]) > count
    # It covers the cloud: every part of it has vertices near.
    low, high = (np.quantile(np.column_stack([cloud[a] for a in "xy"]), q, axis=0) for q in (0.05, 0.95))
    assert (xyz[:, :2].min(axis=0) < low).all() and (xyz[:, :2].max(axis=0) > high).all()
    assert snapshot(moving.folder) == before
    assert sorted(snapshot(out)) == ["dense_report.txt", "depth_maps.png", "fused.ply", "meshed-poisson.ply"]


def test_bad_input_to_the_reconstructor_is_told_in_a_line(
    moving: Workspace, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sparse, images, out = moving.folder / "sparse_refractive/0", moving.folder / "images", tmp_path / "dense"
    given = {"--input_path": str(sparse), "--image_path": str(images), "--output_path": str(out)}
    bare = tmp_path / "bare"
    bare.mkdir()
    write_model(moving.model, bare)
    full = tmp_path / "full"
    full.mkdir()
    (full / "note.txt").write_text("mine")
    small = tmp_path / "small"
    small.mkdir()
    for name in moving.truth.names:
        pycolmap.Bitmap.from_array(np.zeros((30, 40, 3), np.uint8)).write(small / name)
    cases = {
        "does not exist": {"--input_path": str(tmp_path / "no")},
        "has no refraction.json": {"--input_path": str(bare)},
        "there is no folder": {"--image_path": str(tmp_path / "no")},
        "cannot be read": {"--image_path": str(bare)},
        "40 x 30 pixels": {"--image_path": str(small)},
        "not empty": {"--output_path": str(full)},
        "there is no image 'x.jpg'": {"--reference_image": "x.jpg"},
        "step -1": {"--step": "-1"},
        "min_num_views 40": {"--min_num_views": "40"},
    }
    for words, change in cases.items():
        line = [word for pair in {**given, **change}.items() for word in pair]
        assert main(["dense_reconstructor", *line]) in (1, 2)
        error = capsys.readouterr().err
        assert words in error, (words, error)
        assert "Traceback" not in error and not out.exists()
    assert snapshot(full) == {"note.txt": b"mine"}


def test_bad_input_to_the_mesher_is_told_in_a_line(tmp_path: Path) -> None:
    out = tmp_path / "mesh.ply"
    rng = np.random.default_rng(0)
    xyz = np.column_stack([rng.uniform(-1, 1, (500, 2)), np.zeros(500)])
    up = np.broadcast_to([0.0, 0.0, 1.0], xyz.shape)
    colours = np.zeros(xyz.shape, np.uint8)

    def cloud(name: str, count: int, points: Array = xyz, facing: Array = up) -> Path:
        write_point_cloud(tmp_path / name, points[:count], facing[:count], colours[:count])
        return tmp_path / name

    def error(path: Path, **options: float) -> str:
        return error_of(lambda: poisson_mesh(path, out, PoissonMeshingOptions(**options)))  # type: ignore[arg-type]

    whole = cloud("whole.ply", 500)
    text = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    bare = tmp_path / "bare.ply"
    bare.write_text(text + "0 0 0\n")
    cut = tmp_path / "cut.ply"
    cut.write_bytes(whole.read_bytes()[:-100])
    rubbish = tmp_path / "rubbish.ply"
    rubbish.write_bytes(b"hello")
    assert "there is no file" in error(tmp_path / "no.ply")
    assert "is a folder" in error(tmp_path)
    assert "not a PLY file" in error(rubbish)
    assert "no normals" in error(bare)
    assert "cut off" in error(cut)
    assert "0 points" in error(cloud("empty.ply", 0))
    assert "1 points" in error(cloud("one.ply", 1))
    assert "no normal" in error(cloud("nan.ply", 500, facing=np.zeros(xyz.shape)))
    assert "at one place" in error(cloud("same.ply", 500, points=np.zeros(xyz.shape)))
    assert "smaller --PoissonMeshing.trim" in error(whole, trim=12.0, depth=6)
    deeper = tmp_path / "new" / "folder" / "mesh.ply"
    options = PoissonMeshingOptions(trim=12.0, depth=6)
    assert "smaller" in error_of(lambda: poisson_mesh(whole, deeper, options))
    assert not (tmp_path / "new").exists()
    assert "depth 99" in error_of(lambda: PoissonMeshingOptions(depth=99))
    assert not out.exists()
    assert "is the input" in error_of(lambda: poisson_mesh(whole, whole, PoissonMeshingOptions(), overwrite=True))
    points, facing = read_point_cloud(whole)
    np.testing.assert_allclose(points, xyz, atol=1e-7)
    np.testing.assert_allclose(facing, up)


def test_options_that_make_no_sense_are_told() -> None:
    for name, value in (
        ("num_references", 0), ("max_num_images", 0), ("step", 1000),
        ("max_image_size", 50), ("window_size", 3), ("max_error", 0.0),
        ("min_correlation", 1.0), ("min_num_views", 1), ("max_reproj_error", 0.0), ("min_tri_angle", -1.0),
        ("max_depth_error", 0.0),
    ):  # fmt: skip
        assert name in error_of(lambda name=name, value=value: DenseOptions(**{name: value}))  # type: ignore[misc]


@pytest.mark.parametrize(
    "command, option", [("dense_reconstructor", "--num_references"), ("poisson_mesher", "--PoissonMeshing.trim")]
)
def test_help(command: str, option: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([command, "--help"])
    assert ended.value.code == 0
    assert option in capsys.readouterr().out
