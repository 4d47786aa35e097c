"""What states remember of a gate that is shut (`Gate.pause`).

`State.memory` and `BatchState.memory` hold the count at every node, so that it is stored, resumed
and sent to other devices as all that the next step depends on.
"""

from __future__ import annotations

from collections.abc import Mapping

from pdcorrect.corrector.gate import Gate
from pdcorrect.corrector.placements import Values

PAUSE = "gate_pause"
"""For how many steps more a gate is shut, in the memory of states; absent where it is open."""


def steps_left(gate: Gate | None, memory: Mapping[str, Values]) -> Values | None:
    """For how many steps the gate of each scene is shut, (1,) or (B,); None where none is.

    Never for more than its own pause, whichever gate counted before.
    """
    if gate is None or PAUSE not in memory:
        return None
    kept = memory[PAUSE]
    return kept[..., 0, 0].reshape(-1).clip(max=gate.pause)
