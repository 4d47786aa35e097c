"""A hook of hexahedra by Gmsh: ``hook.msh``.  Needs ``pip install gmsh``.

A bar of 100 mm x 100 mm along x, a quarter of a circle, and a bar along z.  Cells are hexahedra
where every surface is transfinite and recombined and is then swept: without `Recombine`
Gmsh makes wedges, and without transfinite curves a mesh that cannot be swept with so few cells.
"""

import sys
from pathlib import Path

import gmsh

CELL = 50  # mm, of the coarse mesh; the file is in mm, which the scene tells by its `scale`
WIDTH = 2 * CELL
STRAIGHT, RADIUS, ARM = 300, 150, 150  # mm: first bar, inner radius of the bend, second bar


def main(path: Path) -> None:
    """Write the mesh."""
    gmsh.initialize(["-noenv"], readConfigFiles=False)
    gmsh.option.setNumber("General.Terminal", 0)
    geo = gmsh.model.geo
    outer = RADIUS + WIDTH
    end, top = STRAIGHT + outer, outer + ARM

    def point(x: float, z: float) -> int:
        return geo.addPoint(x, 0, z)

    # sections from the clamp to the tip: a point on the outside of the bend, one on the inside
    sections = [
        (point(0, 0), point(0, WIDTH)),
        (point(STRAIGHT, 0), point(STRAIGHT, WIDTH)),
        (point(end, outer), point(end - WIDTH, outer)),
        (point(end, top), point(end - WIDTH, top)),
    ]
    centre = point(STRAIGHT, outer)
    across = [geo.addLine(a, b) for a, b in sections]
    bend = round(1.57 * (RADIUS + 0.5 * WIDTH) / CELL)
    bodies = []
    for k, cells in enumerate((STRAIGHT // CELL, bend, ARM // CELL)):
        (a, b), (c, d) = sections[k], sections[k + 1]
        if k == 1:
            along = geo.addCircleArc(a, centre, c), geo.addCircleArc(b, centre, d)
        else:
            along = geo.addLine(a, c), geo.addLine(b, d)
        loop = geo.addCurveLoop([along[0], across[k + 1], -along[1], -across[k]])
        surface = geo.addPlaneSurface([loop])
        for curve in along:
            geo.mesh.setTransfiniteCurve(curve, cells + 1)
        for curve in across[k : k + 2]:
            geo.mesh.setTransfiniteCurve(curve, WIDTH // CELL + 1)
        geo.mesh.setTransfiniteSurface(surface, cornerTags=[a, c, d, b])
        geo.mesh.setRecombine(2, surface)
        swept = geo.extrude([(2, surface)], 0, WIDTH, 0, [WIDTH // CELL], recombine=True)
        bodies += [tag for dimension, tag in swept if dimension == 3]
    geo.synchronize()
    gmsh.model.addPhysicalGroup(3, bodies, name="hook")  # with a group, only its cells are saved
    gmsh.model.mesh.generate(3)
    gmsh.write(str(path))
    gmsh.finalize()


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "hook.msh"))
