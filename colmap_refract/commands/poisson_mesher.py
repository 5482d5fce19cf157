"""`poisson_mesher`: a mesh through dense points, by COLMAP's Poisson surface reconstruction."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from colmap_refract.commands.progress import ProgressLine
from colmap_refract.dense.options import PoissonMeshingOptions


@dataclass(frozen=True, kw_only=True)
class PoissonMesher:
    """Mesh the points of a PLY file with normals, such as dense_reconstructor's fused.ply."""

    input_path: Path
    """PLY file of points with normals."""
    output_path: Path
    """PLY file of the mesh to write."""
    PoissonMeshing: PoissonMeshingOptions = PoissonMeshingOptions()
    overwrite: bool = False
    """Replace a file that is at output_path."""

    def run(self) -> None:
        """Check, mesh, report."""
        from colmap_refract.dense.meshing import poisson_mesh

        with ProgressLine() as line:
            mesh = poisson_mesh(
                self.input_path, self.output_path, self.PoissonMeshing, overwrite=self.overwrite, say=line.say
            )
        print(f"Points:    {mesh.num_points}")
        print(f"Octree:    depth {mesh.depth}, trimmed at {mesh.trim:g}")
        print(f"Mesh:      {mesh.num_vertices} vertices")
        print(f"\nWritten to {self.output_path}")
