"""``python -m pdcorrect.fem.vtk_process FILE TARGET PREFIX``: VTK reads a file.

In a process of its own, which imports only what it needs of VTK and so starts sooner than pyvista.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
from vtkmodules import vtkIOLegacy, vtkIOXML
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkObject
from vtkmodules.vtkCommonDataModel import vtkGenericCell, vtkUnstructuredGrid

_READERS = {
    ".vtu": vtkIOXML.vtkXMLUnstructuredGridReader, ".pvtu": vtkIOXML.vtkXMLPUnstructuredGridReader,
    ".vts": vtkIOXML.vtkXMLStructuredGridReader, ".vtr": vtkIOXML.vtkXMLRectilinearGridReader,
    ".vti": vtkIOXML.vtkXMLImageDataReader, ".vtk": vtkIOLegacy.vtkDataSetReader,
}  # fmt: skip


def _read(path: str) -> Any:
    """A file's unstructured grid; ends the process if VTK says it failed."""
    reader: Any = _READERS[Path(path).suffix.lower()]()
    reader.SetFileName(path)
    if isinstance(reader, vtkIOLegacy.vtkDataSetReader):  # else the first of each kind
        reader.ReadAllScalarsOn()
        reader.ReadAllColorScalarsOn()
        reader.ReadAllFieldsOn()
    reader.Update()
    grid = reader.GetOutput()
    if reader.GetErrorCode() or grid is None or not grid.GetNumberOfCells():
        sys.exit(1)
    if isinstance(grid, vtkUnstructuredGrid):
        return grid
    from vtkmodules.vtkFiltersCore import vtkAppendFilter

    turned = vtkAppendFilter()
    turned.SetOutputPointsPrecision(turned.DOUBLE_PRECISION)
    turned.AddInputData(grid)
    turned.Update()
    return turned.GetOutput()


def write_grid(path: str, target: str, prefix: str) -> None:
    """Write points, cells and, by names behind a prefix, whole numbers of cells as NumPy arrays."""
    vtkObject.SetGlobalWarningDisplay(0)  # damaged files make VTK print pages
    grid = _read(path)
    count = grid.GetNumberOfCells()
    types = np.fromiter(map(grid.GetCellType, range(count)), np.uint8, count)
    names, dimensions = [], []
    for number in np.unique(types).tolist():
        cell = vtkGenericCell.InstantiateCell(number)
        words = re.findall("[A-Z]+[^A-Z]*", cell.GetClassName()) if cell else []
        names.append("_".join(words).lower() or f"VTK {number}")
        dimensions.append(cell.GetCellDimension() if cell else 0)
    data, table = grid.GetCellData(), grid.GetCells()
    values = {
        prefix + (data.GetArrayName(k) or ""): vtk_to_numpy(data.GetArray(k))  # type: ignore[no-untyped-call]
        for k in range(data.GetNumberOfArrays())
        if data.GetArray(k) is not None  # as text
    }
    points, starts, nodes = (
        vtk_to_numpy(part)  # type: ignore[no-untyped-call]
        for part in (
            grid.GetPoints().GetData(), table.GetOffsetsArray(), table.GetConnectivityArray()
        )
    )  # fmt: skip
    np.savez(
        target, points=points, types=types, starts=starts, nodes=nodes, names=names,
        dimensions=dimensions, **{name: x for name, x in values.items() if x.dtype.kind in "iu"},
    )  # fmt: skip


if __name__ == "__main__":
    write_grid(*sys.argv[1:])
