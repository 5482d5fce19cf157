"""What a user can ask for, declared once: the Python interface, the command line and its help come from here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Literal, get_args

import numpy as np

from colmap_refract.errors import RefractError
from colmap_refract.interface import Layers

Scenario = Literal["moving_interface", "static_interface", "fixed_camera", "camera_housing"]
ScenarioOrAuto = Literal["auto", "moving_interface", "static_interface", "fixed_camera", "camera_housing"]
InterfaceShape = Literal["plane", "soft", "soft_as_printed", "auto"]
Residual = Literal["pixels", "scene"]
WaveNodes = Literal["height", "slopes"]
Loss = Literal["trivial", "huber", "soft_l1", "cauchy"]

_STEEPEST_DEG, _MOST_WAVE_MODES = 17.0, 200
_LEAST_INDEX, _LARGEST_INDEX = 0.25, 4.0
"""Of one medium relative to another: beyond, a slip of the decimal point."""


@dataclass(frozen=True, kw_only=True)
class BundleAdjustmentOptions:
    """What the adjustment may change, and how it is solved."""

    refine_rig_from_world: bool = True
    """Refine the poses. Held poses must be known in units of the true scale."""
    refine_points3D: bool = True
    """Refine the points."""
    refine_focal_length: bool = False
    """Refine the focal lengths. Only with many obliques: refraction and focal length look alike."""
    refine_principal_point: bool = False
    """Refine the principal points."""
    refine_extra_params: bool = False
    """Refine the distortion parameters."""
    loss_function_type: Loss = "cauchy"
    """Robust loss on the reprojection errors."""
    loss_function_scale: float | None = None
    """Scale of the loss, px. By default four times the noise that the residuals show."""
    max_num_iterations: int = 300
    """Of the solver, each time it runs."""
    function_tolerance: float = 1e-9
    """Relative change of the cost at which the solver stops."""

    def __post_init__(self) -> None:
        scale = self.loss_function_scale
        if scale is not None and not 0 < scale < np.inf:
            raise RefractError(f"loss_function_scale {scale:g} px is not positive")
        if self.max_num_iterations < 1:
            raise RefractError(f"max_num_iterations {self.max_num_iterations}: give 1 or more")
        if not 0 <= self.function_tolerance < 1:
            raise RefractError(
                f"function_tolerance {self.function_tolerance:g}: give a small number from 0 on, e.g. 1e-9"
            )


@dataclass(frozen=True, kw_only=True)
class ImageNotes:
    """What is known of single images, by name."""

    interface_groups: Mapping[str, str] = field(default_factory=dict)
    """Image name to group name: the images of a group are known to share one interface."""
    dry_images: frozenset[str] = frozenset()
    """Images taken without any interface."""


@dataclass(frozen=True, kw_only=True)
class RefinerRequest:
    """How a model photographed through a plane interface is to be refined; the scenario may be left open."""

    scenario: ScenarioOrAuto
    """What is shared.
    moving_interface: nothing, each image has its own pose and plane; static_interface: one plane,
    fixed in the world; fixed_camera: one pose, a plane per image; camera_housing: one plane per
    camera, fixed in the camera. auto (of the refiner): the simplest of these that predicts
    observations held out from a refinement as well as any; name the scenario if you know it."""

    refractive_index: float = 1.333
    """Of the medium the scene is in, relative to the camera's. Fresh water 1.333, sea water 1.340."""
    layer_thickness: tuple[float, ...] = ()
    """Thickness of each wall between camera and water, nearest the camera first.
    In metres if interface_distance is given, otherwise in units of the model."""
    layer_refractive_index: tuple[float, ...] = ()
    """Refractive index of each wall. Glass 1.52, acrylic 1.49."""

    interface_distance: float | None = None
    """Distance, in metres, of the reference image's projection centre from the interface.
    Makes the result metric."""
    interface_normal: tuple[float, float, float] | None = None
    """Normal of the interface, from the camera into the water, in the camera's frame.
    In that of the reference image, if the interface is fixed in the world. A start, unless
    refine_interface_normal is off."""
    refine_interface_distance: bool = True
    """Off: every image's distance is held at interface_distance."""
    refine_interface_normal: bool = True
    """Off: the normal is held at interface_normal, or the optical axis."""
    initial_distance_ratio: float | None = None
    """Distance to start from, as a fraction of the median depth. By default several are tried."""
    refine_refractive_index: bool = False
    """Refine the index of the water. Rarely determined by the data; the report says if it is not."""

    reference_image: str = ""
    """Name of the image that interface_distance and interface_normal speak of.
    A fixed camera keeps its pose. By default the one with most observations."""
    reference_rays: bool = False
    """Put every point that the reference image sees on the refracted ray of its keypoint there, exactly:
    the paper's hard constraint with a reference image. Its noise goes into all points, so do so only
    with a reference that is better than the rest. Points that it does not see are placed afterwards."""
    residual: Residual = "pixels"
    """With reference_rays or soft_as_printed. pixels: errors in the images; scene: the paper's, distances
    in the scene between a point and the refracted rays of its keypoints."""

    interface_shape: InterfaceShape = "plane"
    """plane: the interfaces are flat; soft: open water, whose surface waves, differently in every image;
    soft_as_printed: the paper's own soft constraint, a normal for every observation, smooth among
    neighbours, for up to tens of images of some hundreds of points; auto: plane or soft, whichever
    predicts held-out observations best."""
    wave_slope_deg: float | None = None
    """Root mean square slope of the waves, over both axes. With soft; estimated by default."""
    wave_smoothness: float | None = None
    """The paper's lambda, with soft_as_printed: what the normals' differences weigh, in px^2 (with
    residual scene, in squared units of the model). None suits all scenes, so there is no default, but
    wave_slope_deg s gives one: 2 sigma^2 / ((m - 1) s^2), with the pixel_noise sigma and m keypoints in a
    neighbourhood. That is for waves shorter than a neighbourhood; for longer ones give wavelength, too."""
    wave_radius: float | None = None
    """Of the neighbourhoods among whose keypoints normals are alike, px, with soft_as_printed.
    By default they hold about ten keypoints."""
    pixel_noise: float = 0.5
    """Standard deviation of each coordinate of a keypoint, px, without waves. For the wave_smoothness of
    soft_as_printed; otherwise it is estimated."""
    wavelength: float | None = None
    """Length of the waves, in metres if interface_distance is given, otherwise in units of the model.
    With soft; estimated by default. With soft_as_printed it makes wave_smoothness what it should be."""
    num_wave_modes: int = 36
    """Unknowns of each image's surface, with soft: its most probable shapes.
    What they cannot take counts as noise."""
    wave_nodes: WaveNodes = "height"
    """What nodes over each image hold, with soft. height: a surface, whose slopes belong together; slopes:
    two free slopes and no height, as the paper's normals. What is written is a surface, the closest one."""
    level_prior: bool = True
    """Water is level on average: with soft, the planes of a moving interface scatter about one."""
    level_tilt_deg: float | None = None
    """Standard deviation of the planes' tilt, in each of two directions. Estimated by default."""
    level_lift: float | None = None
    """Standard deviation of the planes' height, over the interface distance. Estimated by default."""

    average_groups: bool = False
    """Average the keypoints of each interface group per track, weighted by their spread.
    For the frames of a fixed camera."""

    filter_max_reproj_error: float = 4.0
    """Observations with a larger refractive reprojection error, px, are removed. 0: keep all."""
    filter_min_tri_angle: float | None = None
    """Points whose refracted rays meet at a smaller angle, degrees, are removed.
    By default 0.5, and 0.05 with a fixed camera, whose rays differ by refraction only. 0: keep all."""

    BundleAdjustment: BundleAdjustmentOptions = BundleAdjustmentOptions()
    num_threads: int = -1
    """Of the solver; -1: as many as there are cores."""
    random_seed: int = 0
    """Of the choice of tracks that a start is tried on."""

    def __post_init__(self) -> None:
        if len(self.layer_thickness) != len(self.layer_refractive_index):
            raise RefractError(
                f"{len(self.layer_thickness)} layer_thickness and {len(self.layer_refractive_index)} "
                "layer_refractive_index: give one of each per wall"
            )
        _ = self.layers
        if self.interface_distance is not None and not 0 < self.interface_distance < np.inf:
            raise RefractError(
                f"interface_distance {self.interface_distance:g} is not in front of the camera: give metres > 0"
            )
        if self.interface_normal is not None:
            normal = np.array(self.interface_normal)
            if not (np.isfinite(normal).all() and np.linalg.norm(normal) > 0):
                raise RefractError(f"interface_normal {self.interface_normal} is not a direction: give e.g. 0 0 1")
            if normal[2] <= 0:
                raise RefractError(
                    f"interface_normal {self.interface_normal} points to the interface behind the camera: "
                    "it must point from the camera into the water (z > 0)"
                )
        if not self.refine_interface_distance and self.interface_distance is None:
            raise RefractError("refine_interface_distance is off, but there is no interface_distance to hold")
        if self.initial_distance_ratio is not None and not 0 < self.initial_distance_ratio < 1:
            raise RefractError(
                f"initial_distance_ratio {self.initial_distance_ratio:g} puts the interface behind the camera or "
                "beyond the points: give a fraction between 0 and 1"
            )
        for name in ("filter_max_reproj_error", "filter_min_tri_angle"):
            value = getattr(self, name)
            if value is not None and not 0 <= value < np.inf:
                raise RefractError(f"{name} {value:g}: give a number from 0 on; 0 keeps all")
        for index in (self.refractive_index, *self.layer_refractive_index):
            if not _LEAST_INDEX <= index <= _LARGEST_INDEX:
                raise RefractError(f"a refractive index of {index:g} is no medium's: water has 1.333, glass 1.52")
        if self.num_threads == 0 or self.num_threads < -1:
            raise RefractError(f"num_threads {self.num_threads}: give 1 or more, or -1 for one per core")
        if self.wave_slope_deg is not None and not 0 < self.wave_slope_deg <= _STEEPEST_DEG:
            raise RefractError(
                f"wave_slope_deg {self.wave_slope_deg:g}: give degrees from just over 0 to {_STEEPEST_DEG:g}, where "
                "waves break"
            )
        if self.wavelength is not None and not 0 < self.wavelength < np.inf:
            raise RefractError(f"wavelength {self.wavelength:g} is not positive: give the length from crest to crest")
        if not 4 <= self.num_wave_modes <= _MOST_WAVE_MODES:
            raise RefractError(
                f"num_wave_modes {self.num_wave_modes}: give 4 to {_MOST_WAVE_MODES}; the default is enough for a "
                "surface that is smooth over the view"
            )
        if self.wave_nodes not in get_args(WaveNodes):
            raise RefractError(f"wave_nodes '{self.wave_nodes}': give {' or '.join(get_args(WaveNodes))}")
        if self.wave_nodes == "slopes" and self.interface_shape not in ("soft", "auto"):
            raise RefractError("wave_nodes slopes belongs to interface_shape soft: choose that, or leave it out")
        self._check_reference()
        for name in ("level_tilt_deg", "level_lift"):
            value = getattr(self, name)
            if value is not None and not 0 < value < np.inf:
                raise RefractError(f"{name} {value:g} is not a spread: give a number > 0, or level_prior 0")
        if self.random_seed < 0:
            raise RefractError(f"random_seed {self.random_seed}: give a number from 0 on")

    def _check_reference(self) -> None:
        """What a reference image, and the soft constraint as printed, cannot be combined with."""
        printed = self.interface_shape == "soft_as_printed"
        adjustment = self.BundleAdjustment
        if self.reference_rays and self.interface_shape != "plane":
            raise RefractError(
                f"reference_rays are of flat interfaces, not interface_shape {self.interface_shape}: for waves with a "
                "reference image use soft_as_printed without reference_rays"
            )
        if not printed:
            for name in ("wave_smoothness", "wave_radius"):
                if getattr(self, name) is not None:
                    raise RefractError(
                        f"{name} belongs to interface_shape soft_as_printed: choose that, or leave it out"
                    )
        if not (self.reference_rays or printed):
            if self.residual != "pixels":
                raise RefractError(
                    f"residual {self.residual} takes a reference image: add reference_rays, or use soft_as_printed"
                )
            return
        what = "soft_as_printed" if printed else "reference_rays"
        if not adjustment.refine_points3D:
            raise RefractError(f"{what} seeks the points: it cannot hold them (BundleAdjustment.refine_points3D)")
        in_scene = self.residual == "scene" or printed
        what = "residual scene" if not printed else what
        if in_scene and any(self.layer_thickness):
            raise RefractError(f"{what} is for a single refracting surface: leave out layer_thickness")
        if in_scene and (
            adjustment.refine_focal_length or adjustment.refine_principal_point or adjustment.refine_extra_params
        ):
            raise RefractError(f"{what} takes the intrinsics as known: hold them")
        if not printed:
            return
        if self.refine_refractive_index:
            raise RefractError("soft_as_printed takes the index as known: leave out refine_refractive_index")
        if self.wave_smoothness is None and self.wave_slope_deg is None:
            raise RefractError(
                "soft_as_printed has no smoothness that suits all scenes: give wave_slope_deg, the waves' root mean "
                "square slope, or wave_smoothness, the paper's lambda"
            )
        if self.wave_smoothness is not None and not 0 < self.wave_smoothness < np.inf:
            raise RefractError(
                f"wave_smoothness {self.wave_smoothness:g} cannot weigh anything: give a number > 0; without any the "
                "normals are not determined"
            )
        if not 0 < self.pixel_noise < np.inf:
            raise RefractError(f"pixel_noise {self.pixel_noise:g} px is not positive; keypoints have about 0.5")
        if self.wave_radius is not None and not 0 < self.wave_radius < np.inf:
            raise RefractError(f"wave_radius {self.wave_radius:g} holds no neighbours: give pixels > 0")

    def with_scenario(self, scenario: Scenario) -> RefinerOptions:
        """The same with the scenario named."""
        rest = {part.name: getattr(self, part.name) for part in fields(RefinerRequest) if part.name != "scenario"}
        return RefinerOptions(scenario=scenario, **rest)

    @property
    def layers(self) -> Layers:
        """The media behind the first interface, with thicknesses as given."""
        return Layers(
            thickness=tuple(self.layer_thickness), index=(*self.layer_refractive_index, self.refractive_index)
        )


@dataclass(frozen=True, kw_only=True)
class RefinerOptions(RefinerRequest):
    """How a model photographed through a plane interface is refined."""

    scenario: Scenario
    """What is shared.
    moving_interface: nothing, each image has its own pose and plane; static_interface: one plane,
    fixed in the world; fixed_camera: one pose, a plane per image; camera_housing: one plane per
    camera, fixed in the camera."""

    def __post_init__(self) -> None:
        if self.scenario not in get_args(Scenario):
            raise RefractError(
                f"scenario '{self.scenario}' is none of {', '.join(get_args(Scenario))}: name one, or have "
                "choose_scenario find it"
            )
        super().__post_init__()

    @property
    def min_tri_angle(self) -> float:
        """`filter_min_tri_angle` with its default."""
        if self.filter_min_tri_angle is not None:
            return self.filter_min_tri_angle
        return 0.05 if self.scenario == "fixed_camera" else 0.5
