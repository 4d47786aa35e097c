"""What the tables of ``docs/results.md`` have in their rows; `table` fills them from records."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """A released model's evaluation on unseen meshes.

    Attributes
    ----------
    model, record, run : str
        The record is a folder of `RESULTS`; the run is the corrected one.
    thesis : float
        Reported mean Omega of the thesis's own model of this motion, %.
    converged : str or None
        Record that has the distances from runs which are converged in time, where ``record`` has
        none: of earlier weights or another gate, its run is called as the model.
    """

    model: str
    record: str
    run: str
    thesis: float
    converged: str | None = None


_IMPULSE, _STRETCH, _TORSION = 95.9, 99.1, 91.3
_KICKED = "impulse-as-published-total-mass"
_HEAVY = "torsion-as-published-total-mass"
_FURTHER = "through-further/model"
ROWS = (
    Row("impulse-as-published", "impulse-as-published-seventh", "model", _IMPULSE),
    Row(_KICKED, f"{_KICKED}-fourth", "model", _IMPULSE),
    Row("stretch-as-published", "stretch-as-published-sixth", "model", _STRETCH),
    Row("stretch-as-published-total-mass", "stretch-as-published-second", "model", _STRETCH),
    Row("torsion-as-published", "torsion-as-published-second", "torsion-as-published", _TORSION),
    Row(_HEAVY, "torsion-as-published-second", _HEAVY, _TORSION),
    Row("impulse-exact", "impulse-exact-third", "model", _IMPULSE, "impulse-exact"),
    Row("stretch-exact", "stretch-exact-second", _FURTHER, _STRETCH, "stretch-exact"),
    Row("torsion-exact", "torsion-exact-seventh", "model", _TORSION, "torsion-exact-third"),
)
HEADINGS = (
    "model", "base", "thesis", "corrected: Ω mean", "95 %", "median", "worst",
    "RMS error removed, %", "base alone: Ω mean, worst", "of the base's error: mean, median",
    "intermediate mesh: Ω mean, worst", "RMS, mm", "to converged in time, mm: base, corrected",
)  # fmt: skip


OTHERS = (
    "other-family", "stiffer", "more-compressible", "stronger", "half-step", "double-step",
    "half-refined", "long",
)  # fmt: skip
"""Splits of the second and the third table, in their order."""
OTHER_STEPS = ("double-step", "half-step")
"""Splits whose records have gates of before these knew time steps; they refuse all of them now."""
OTHER_WEIGHTS = ("torsion-exact-double-step", "torsion-exact-half-step")
"""Records of the second and third table of which a model had other weights than it has now."""
OTHER_HEADINGS = (
    "model", "split", "simulations", "steps refused, %", "base alone: Ω mean",
    "corrected: Ω mean, worst", "error over the base's: median, largest",
    "without a gate: the same",
)  # fmt: skip

BODIES = ("larger", "smaller", "beams", "one-clamp", "other-family")
"""Records of the fourth table, in its order."""
BODY_HEADINGS = (
    "model", "bodies", "nodes", "simulations", "farthest measure of all", "steps refused, %",
    "base alone: Ω mean", "corrected: Ω mean, worst", "error over the base's: each",
)  # fmt: skip

HARM = 1.05
"""Times the base's RMS error: what is more counts as harm."""
STEP_HEADINGS = (
    "model", "single steps: error over the base's, median, largest", "rollouts: the same",
    f"rollouts above {HARM}", "their single steps: largest",
)  # fmt: skip

PUBLISHED = ("impulse-as-published", "stretch-as-published", "torsion-as-published")
MEASURED = (*PUBLISHED, "impulse-exact", "stretch-exact", "torsion-exact")
"""Data sets of the sixth table."""
WITHOUT_NETWORK = {
    "consistent mass": "consistent mass",
    "hex8-mean": "element `hex8-mean`",
    "hex8-bubble": "element `hex8-bubble`",
    "hex8-bubble-mean": "element `hex8-bubble-mean`",
    "fitted stiffness": "Young's modulus times {factors}, fitted",
    "total-mass": "the reference's total mass",
    "best": "the best coarse model",
    "intermediate": "intermediate mesh",
}
"""Runs of the sixth table, in its order, and what they are called there."""
JOINT_RECORD = "all-as-published"
JOINT_HEADINGS = (
    "data set", "one model for all: Ω mean", "95 %", "median", "worst",
    "model of this motion: Ω mean, worst", "difference", f"rollouts above {HARM}",
    "intermediate mesh: Ω mean", "stress error, %: one model, of this motion, intermediate",
)  # fmt: skip

_TORSIONS = "torsion-exact-fourth"
_IMPULSES, _STRETCHES = "impulse-exact-second", "stretch-exact-second"
_SPREAD = "200 bodies, 2 loads each, from scratch, seed 0"
_AXES = "plain base, 200 bodies, the scene's axes"
TRAININGS = (
    ("torsion exact", "torsion-exact-seventh", "model", "released: these again, four steps only"),
    ("torsion exact", "torsion-exact-sixth", "model", "before: then 638 bodies, a load each"),
    ("torsion exact", "torsion-exact-fifth", "model", "before that: then 199 bodies, 2 loads each"),
    ("torsion exact", _TORSIONS, "models/torsion-exact", "first: 90 bodies, 10 loads each"),
    ("torsion exact", _TORSIONS, "best-longer/model", _SPREAD),
    ("torsion exact", _TORSIONS, "best-second/model", "the same, seed 1"),
    ("torsion exact", _TORSIONS, "best-third/model", "the same, seed 2"),
    ("torsion exact", "torsion-many", "best-200/model", "200 bodies, two thirds of the time"),
    ("torsion exact", "torsion-many", "best-100/model", "100 of them"),
    ("torsion exact", "torsion-many", "best-50/model", "50 of them"),
    ("torsion exact", "torsion-exact-plain", "model", "plain base, from the released weights"),
    ("torsion exact", "torsion-many", "axes-unrolled/model", _AXES),
    ("impulse exact", "impulse-exact-third", "model", "released"),
    ("impulse exact", _IMPULSES, "through-further/model", "before its last part"),
    ("impulse exact", _IMPULSES, "models/impulse-exact", "before its last two"),
    ("impulse exact", "impulse-exact-plain", "model", "plain base, from the released weights"),
    ("impulse exact", _IMPULSES, "plain/model", "plain base, six minutes"),
    ("stretch exact", _STRETCHES, "through-further/model", "released"),
    ("stretch exact", _STRETCHES, "models/stretch-exact", "before it was trained on"),
    ("stretch exact", "stretch-exact-plain-further", "model", "plain base, 573 bodies, further"),
    ("stretch exact", "stretch-exact-plain", "model", "plain base, 573 bodies, a load each"),
    ("stretch exact", _STRETCHES, "plain/model", "plain base, two minutes"),
)
"""Rows of the eighth table: evaluation split, record, run, and what it is called there."""
TRAINING_HEADINGS = (
    "evaluation split of", "training", "base", "Ω mean", "95 %", "median", "worst",
    "of the base's error: mean", "rollouts above 1.05", "intermediate mesh nearer",
)  # fmt: skip
