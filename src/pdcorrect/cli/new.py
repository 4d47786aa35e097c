"""The command ``pdcorrect new``: a commented scene to begin with."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pdcorrect.cli import common
from pdcorrect.errors import OutputError

TEMPLATE = """\
# A soft beam that bends under its weight.  Units are m, kg, s, N and Pa.
# Lines that begin with "#:" are keys to try: take the mark away.  docs/scene.md lists all.
name = "my scene"

[body]
shape = "beam"  # or "cross", "weight", "voxels", "file"
cells = [12, 2, 2]  # along x, y, z
cell_size = 0.02
#: origin = [0.0, 0.0, 0.0]

[material]
young = 1e6
poisson = 0.45
density = 1000.0

[time]
step = 0.01
frames = 60
#: integrator = "midpoint"

[damping]
viscosity = 0.002  # s

[[clamps]]
region = { plane = "x", at = "min" }
#: components = ["x"]
#: motion = { times = [0.0, 0.5], displacement = [[0.0, 0.0, 0.0], [0.0, 0.02, 0.0]] }

[[loads]]
kind = "gravity"
acceleration = [0.0, 0.0, -9.81]

#: [[loads]]
#: kind = "pressure"
#: pressure = 200.0
#: region = { plane = "z", at = "max" }
#: window = [0.1, 0.3]

#: [[materials]]
#: region = { box = [[0.0, 0.0, 0.0], [0.12, 0.04, 0.04]] }
#: young = 2e6

#: [[obstacles]]
#: shape = "sphere"
#: centre = [0.2, 0.02, -0.06]
#: radius = 0.05
#: friction = 0.3

#: [[actuators]]
#: direction = [1.0, 0.0, 0.0]
#: stiffness = 2e5
#: activation = [[0.0, 1.0], [0.3, 0.8]]

[[probes]]
name = "tip"
point = [0.24, 0.02, 0.02]

[solver]
element = "hex8-learned"  # or "hex8-enhanced" (the best without learning), "hex27", "hex8"
"""


def new(
    scene: Annotated[Path, typer.Argument(help="File to write, TOML.", show_default=False)],
) -> None:
    """Write a commented scene to begin with."""
    try:
        with scene.open("x", encoding="utf-8") as file:
            file.write(TEMPLATE)
    except FileExistsError:
        raise OutputError(f"{scene} exists: expected the name of a new file.") from None
    except OSError as error:
        raise OutputError(f"{scene} cannot be written ({error.strerror}).") from None
    common.say(f"wrote {scene}; next: pdcorrect simulate {scene} -o {scene.with_suffix('.h5')}")
