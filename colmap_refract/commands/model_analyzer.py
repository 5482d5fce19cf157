"""`model_analyzer`: the report of a model that was refined earlier."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from colmap_refract.errors import RefractError


@dataclass(frozen=True, kw_only=True)
class ModelAnalyzer:
    """Print the report of a model that the refiner wrote earlier."""

    path: Path
    """Folder of the model, with its refraction.json."""

    def run(self) -> None:
        """Read and report."""
        from colmap_refract.files.model_io import read_model
        from colmap_refract.files.sidecar import read_sidecar
        from colmap_refract.refiner.report import report

        model = read_model(self.path)
        sidecar = read_sidecar(self.path)
        unknown = sorted(set(sidecar.images) - {image.name for image in model.images.values()})
        if unknown:
            raise RefractError(f"{self.path}: refraction.json speaks of image '{unknown[0]}', which the model lacks")
        print(report(sidecar))
