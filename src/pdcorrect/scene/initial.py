"""`Initial`: how fast the body moves when a run starts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pdcorrect._config import Strict, Vector

Array = NDArray[np.float64]
_STILL: Vector = (0.0, 0.0, 0.0)


class Initial(Strict):
    """Velocities at time zero: v + w x (X - c) + G (X - c) at the rest position X.

    Attributes
    ----------
    velocity
        v, m/s.
    angular_velocity
        w, rad/s.
    velocity_gradient
        G, rows of the derivatives of v_x, v_y, v_z by x, y, z, 1/s.
    centre
        c, m; the centre of mass by default.
    """

    velocity: Vector = _STILL
    angular_velocity: Vector = _STILL
    velocity_gradient: tuple[Vector, Vector, Vector] = (_STILL, _STILL, _STILL)
    centre: Vector | None = None

    def velocities(self, points: Array, centre_of_mass: Array) -> Array:
        """The field at rest positions (n, 3), m, as (n, 3), m/s."""
        arms = points - (centre_of_mass if self.centre is None else np.array(self.centre))
        spin = np.cross(np.array(self.angular_velocity), arms)
        return np.array(self.velocity) + spin + arms @ np.array(self.velocity_gradient).T
