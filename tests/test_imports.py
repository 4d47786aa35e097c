"""The package's shape: imports point one way, heavy modules stay out until needed."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

SOURCE = Path(__file__).parent.parent / "src" / "pdcorrect"

ORDER = [
    "pdcorrect",
    "errors",
    "toml_text",
    "toml_files",
    "known_keys",
    "explanations",
    "home",
    "machine",
    "interruption",
    "replacement",
    "shapes",
    "scene.regions",
    "scene.bodies",
    "scene.materials",
    "scene.clamps",
    "scene.loads",
    "scene.scene",
    "scene",
    "state",
    "fem",
    "fem.hexahedron",
    "fem.mesh_checks",
    "fem.mesh",
    "fem.mesh_files",
    "fem.quadrature",
    "fem.operators",
    "fem.decomposition",
    "fem.hyperelasticity",
    "fem.energies",
    "fem.blocks",
    "fem.kernels",
    "fem.tangent_kernels",
    "fem.internal_modes",
    "fem.conjugate_gradients",
    "fem.multigrid",
    "fem.factorisation",
    "fem.banded",
    "fem.selection",
    "fem.fields",
    "fem.loads",
    "fem.clamps",
    "fem.materials",
    "fem.assembly",
    "fem.elastic_body",
    "fem.problem",
    "fem.coarse_models",
    "fem.sensitivities",
    "fem.stress",
    "fem.modes",
    "solvers",
    "solvers.linear",
    "solvers.schemes",
    "solvers.integrators",
    "solvers.step",
    "solvers.tangent_solver",
    "solvers.first_hessian",
    "solvers.reactions",
    "solvers.lbfgs",
    "solvers.newton_loop",
    "solvers.implicit",
    "solvers.projective",
    "solvers.newton",
    "solvers.step_solution",
    "solvers.adjoint_solve",
    "solvers.adjoint_terms",
    "solvers.gradients",
    "solvers.adjoint",
    "batch",
    "batch.decomposition",
    "batch.energies",
    "batch.fused",
    "batch.tracing",
    "batch.point_kernel",
    "batch.points",
    "batch.narrowing",
    "batch.levels",
    "batch.bodies",
    "batch.cells",
    "batch.material",
    "batch.tall",
    "batch.sharing",
    "batch.turning",
    "batch.elimination",
    "batch.dense",
    "batch.grid",
    "batch.multigrid",
    "batch.inverses",
    "batch.objective",
    "batch.recording",
    "batch.linear_solver",
    "batch.history",
    "batch.minimise",
    "batch.memory",
    "batch.loads",
    "batch.threads",
    "batch.states",
    "batch.checks",
    "batch.stage",
    "batch.retry",
    "batch.stepper",
    "batch.adjoint",
    "torch_layer",
    "solvers.rollout",
    "solvers.resume",
    "io",
    "io.disk_space",
    "io.superblock",
    "io.growing_file",
    "io.trajectory_reader",
    "io.trajectory",
    "io.vtk",
    "io.stored_problem",
    "metrics",
    "figures.panels",
    "figures.sheet",
    "figures.files",
    "figures.curves",
    "figures.learning",
    "figures.offscreen",
    "figures",
    "toml_config",
    "data",
    "data.config",
    "data.families",
    "data.plan",
    "data.seal",
    "data.schema",
    "data.scene_mesh",
    "data.hdf5_checks",
    "data.shard_reader",
    "data.damage",
    "data.folder",
    "data.missing",
    "data.graph",
    "data.shard_arrays",
    "data.cache",
    "data.sampling",
    "data.samples",
    "data.reader",
    "data.statistics",
    "data.rebuild",
    "data.export_target",
    "data.export",
    "data.import_checks",
    "data.importing",
    "data.import_files",
    "data.engines",
    "data.batch_engine",
    "data.runs",
    "data.simulate",
    "data.manifest",
    "data.check_motion",
    "data.check_file",
    "data.twins",
    "data.check",
    "data.measuring",
    "data.info",
    "data.pictures",
    "data.card",
    "environment",
    "data.produce",
    "data.workers",
    "data.generate",
    "corrector",
    "corrector.values",
    "corrector.rotations",
    "corrector.folds",
    "corrector.frames",
    "corrector.shapes",
    "corrector.bodies",
    "corrector.features",
    "corrector.config",
    "corrector.normaliser",
    "corrector.network",
    "corrector.corrector",
    "corrector.contents",
    "corrector.products",
    "corrector.compiled_network",
    "corrector.compiled_features",
    "corrector.compiled",
    "corrector.cost",
    "corrector.model_description",
    "corrector.model_names",
    "corrector.model_io",
    "corrector.placements",
    "corrector.gate",
    "corrector.foreign",
    "corrector.unknown_inputs",
    "corrector.pause",
    "corrector.decision",
    "corrector.recorded",
    "corrector.batch_bodies",
    "corrector.batch_step",
    "corrector.batch_hybrid",
    "corrector.single_step",
    "corrector.hybrid",
    "corrector.refusal_watch",
    "corrector.released",
    "evaluation",
    "evaluation.resampling",
    "evaluation.physics",
    "evaluation.cases",
    "evaluation.measures",
    "evaluation.rollouts",
    "evaluation.alone",
    "evaluation.evaluation",
    "evaluation.tables",
    "evaluation.candidates",
    "evaluation.speed",
    "training",
    "training.config",
    "training.losses",
    "training.precision",
    "training.recordings",
    "training.resident",
    "training.windows",
    "training.fitting",
    "training.vibrations",
    "training.scenes",
    "training.unrolled",
    "training.world",
    "training.sources",
    "training.teachers",
    "training.lineage",
    "training.optimisation",
    "training.validation",
    "training.history",
    "training.checkpoints",
    "training.progress",
    "training.training",
    "validation",
    "validation.outcome",
    "validation.cases",
    "validation.records",
    "validation.running",
    "validation.prose",
    "validation.page",
    "run_text",
    "refusal_text",
    "comparison_cases",
    "evaluate",
    "report_notes",
    "report",
    "progress",
    "cli_parts",
    "simulate_cli",
    "compare_cli",
    "export_cli",
    "dataset_cli",
    "evaluation_cli",
    "train_cli",
    "validate_cli",
    "cli",
]
"""From bottom to top: a module imports only modules above it in this list."""


def module_name(path):
    parts = list(path.relative_to(SOURCE).with_suffix("").parts)
    if parts[-1] == "__init__":
        parts.pop()
    return ".".join(parts) or "pdcorrect"


def imported(path):
    """Package modules that a file imports at run time (not under TYPE_CHECKING)."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    hidden = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING":
            hidden.update(ast.walk(node))
    for node in ast.walk(tree):
        if node in hidden:
            continue
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("pdcorrect"):
            base = node.module.removeprefix("pdcorrect").lstrip(".")
            for alias in node.names:
                name = f"{base}.{alias.name}".lstrip(".")
                yield name if name in ORDER else (base or "pdcorrect")
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.startswith("pdcorrect"):
                    yield alias.name.removeprefix("pdcorrect").lstrip(".") or "pdcorrect"


def test_every_module_has_its_place():
    assert sorted(module_name(p) for p in SOURCE.rglob("*.py")) == sorted(ORDER)


@pytest.mark.parametrize("path", sorted(SOURCE.rglob("*.py")), ids=module_name)
def test_imports_point_one_way(path):
    here = module_name(path)
    for name in imported(path):
        assert ORDER.index(name) < ORDER.index(here), f"{here} imports {name}"


def test_scikit_fem_is_imported_in_one_place():
    users = [module_name(p) for p in SOURCE.rglob("*.py") if "skfem" in p.read_text()]
    assert users == ["fem.operators"]


def loaded_after(code):
    script = (
        f"{code}\nimport sys; print(' '.join(sorted({{m.split('.')[0] for m in sys.modules}})))"
    )
    out = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return set(out.stdout.splitlines()[-1].split())


HEAVY = {"torch", "pyvista", "vtk", "vtkmodules", "h5py", "meshio", "matplotlib"}


def test_importing_the_package_loads_nothing_heavy():
    assert not loaded_after("import pdcorrect") & (HEAVY | {"numpy", "scipy", "numba", "skfem"})


def test_help_loads_nothing_heavy():
    code = (
        "import sys; sys.argv = ['pdcorrect', '--help']\n"
        "from pdcorrect.cli import app\n"
        "try:\n    app()\nexcept SystemExit:\n    pass"
    )
    assert not loaded_after(code) & (HEAVY | {"numpy", "scipy", "numba", "skfem"})


def test_stepping_loads_neither_torch_nor_files_nor_pictures():
    code = (
        "import pdcorrect as pc\n"
        "scene = pc.Scene(body={'shape': 'beam', 'cells': [2, 1, 1], 'cell_size': 0.1},\n"
        "    material={'young': 1e5, 'poisson': 0.3, 'density': 1e3}, time={'step': 0.01,"
        " 'frames': 1})\n"
        "pc.rollout(pc.ProjectiveDynamics(pc.discretise(scene)))\n"
        "pc.rollout(pc.Newton(pc.discretise(scene)))"
    )
    assert not loaded_after(code) & HEAVY


def test_rendering_does_not_load_torch():
    assert "torch" not in loaded_after("from pdcorrect import figures, report")


def test_public_names_exist():
    import pdcorrect as pc

    for name in pc.__all__:
        assert getattr(pc, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        pc.nothing  # noqa: B018
