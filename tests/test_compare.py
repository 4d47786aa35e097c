"""`compare`: its cases, their reference, what fails or is refused, and what it writes."""

import base64
import csv
import dataclasses
import json
import re
import sys
from pathlib import Path

import meshio
import numpy as np
import pytest

import pdcorrect as pc
from conftest import beam
from hybrid_samples import problems, saved
from pdcorrect.cli.common import BAD_INPUT, FAILED
from pdcorrect.cli.compare import _print_table
from pdcorrect.corrector.gate import Reason
from pdcorrect.errors import InputError
from pdcorrect.evaluation import compare as compare_module
from pdcorrect.evaluation import report
from pdcorrect.evaluation.compare import CASES, HEX27, LEARNED, Case, case_stepper, cases_for
from pdcorrect.evaluation.report import notes, refused_corrections

EXAMPLES = Path(__file__).parent.parent / "examples"
MODEL = "torsion-exact"


@pytest.fixture
def thick():
    """A small beam that is nowhere one cell thick."""
    return beam((3, 2, 2), time={"frames": 2})


@pytest.fixture
def scene_file(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(beam((4, 2, 2), time={"frames": 2}).to_toml(), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def stiff():
    """A scene that a corrector's gate knows the body of, and no step."""
    scene = pc.Scene.load(EXAMPLES / "unseen_cross.toml")
    return scene.with_changes(material={"young": 1e7}, time={"frames": 2})


def labels(cases):
    return [case.label for case in cases]


def test_the_best_coarse_model_is_always_there_and_the_reference_has_its_element(thick):
    found = pc.compare(thick)
    assert found.reference == "fine best PD"
    assert labels(found.rows)[2] == "best coarse PD"
    assert found.runs["fine best PD"].attributes["element"] == pc.best_coarse(thick).solver.element
    by_hand = pc.restrict(
        pc.rollout(pc.ProjectiveDynamics(pc.discretise(pc.best_coarse(thick), 4))),
        to=pc.discretise(thick),
    )
    own = pc.rollout(pc.ProjectiveDynamics(pc.discretise(pc.best_coarse(thick))))
    row = found.rows[2]
    assert row.rms_error == pytest.approx(pc.metrics.rms_error(own, by_hand), rel=1e-9)
    assert row.rms_error < 0.5 * found.rows[0].rms_error
    assert found.rows[0].omega == 0.0  # the zero is the scene's own coarse run
    (told,) = notes(found)
    assert "fine best PD" in told


@pytest.mark.parametrize(
    "changes",
    [
        {"solver": {"element": "hex8-enhanced", "mass": "averaged"}},
        {"solver": {"element": "hex27"}},
    ],
)
def test_scenes_without_another_best_coarse_model_are_compared_as_they_are(thick, changes):
    assert cases_for(thick.with_changes(**changes)) == CASES
    other = thick.with_changes(solver={"element": "hex8-enhanced"})  # of another mass
    assert "best coarse PD" in labels(cases_for(other))


def test_27_node_elements_are_measured_on_the_coarse_nodes_and_all_rows_written_for_paraview(
    program, thick, tmp_path
):
    (tmp_path / "scene.toml").write_text(thick.to_toml())
    folder = tmp_path / "r"
    status, out, _ = program(
        "compare", tmp_path / "scene.toml", "-o", folder, "--vtu", "--hex27", "--no-figures"
    )
    assert status == 0
    rows = {r["label"]: r for r in csv.DictReader((folder / "report.csv").open())}
    assert list(rows)[3] == HEX27.label == "coarse PD, hex27"
    assert int(rows[HEX27.label]["nodes"]) == 7 * 5 * 5
    coarse, steps = pc.discretise(thick), pc.ProjectiveDynamics
    own, fine = (
        pc.restrict(pc.rollout(steps(problem)), to=coarse)
        for problem in (
            pc.discretise(thick, element="hex27"), pc.discretise(pc.best_coarse(thick), 4)
        )
    )  # fmt: skip
    error = float(rows[HEX27.label]["rms_error"])
    assert error == pytest.approx(pc.metrics.rms_error(own, fine), rel=1e-9)
    assert error < 0.3 * float(rows["coarse PD"]["rms_error"])
    record = json.loads((folder / "report.json").read_text())
    assert [case["element"] for case in record["cases"]] == [None] * 5 + ["hex27"]

    names = ["best-coarse-pd", "coarse-newton", "coarse-pd", "coarse-pd-hex27", "fine-best-pd",
             "intermediate-pd"]  # fmt: skip
    assert sorted(path.stem for path in (folder / "vtu").glob("*.pvd")) == names
    for name in names:
        assert f"{name}.pvd" in out
        frames = sorted((folder / "vtu").glob(f"{name}_[0-9]*.vtu"))
        assert len(frames) == 3
        data = meshio.read(frames[-1])
        assert {"displacement", "velocity", "stress", "von_mises"} == set(data.point_data)
        assert {"cell_von_mises", "smallest_volume_ratio"} == set(data.cell_data)
    assert meshio.read(folder / "vtu" / "coarse-pd-hex27_0002.vtu").cells[0].type == "hexahedron27"


def test_27_nodes_have_no_mass_per_node(thick):
    heavy = thick.with_changes(solver={"mass": "per-node"})
    assert HEX27.problem(heavy).mass_rule == "averaged"
    assert HEX27.problem(heavy).mass.sum() == pytest.approx(3 * 2 * 2 * 0.02**3 * 1e3)
    assert HEX27.problem(thick).mass_rule == "lumped"
    assert not HEX27.plain


def test_hex27_is_refused_where_it_is_the_scenes_own(program, thick, tmp_path):
    scene = thick.with_changes(solver={"element": "hex27"})
    (tmp_path / "scene.toml").write_text(scene.to_toml())
    status, _, err = program("compare", tmp_path / "scene.toml", "-o", tmp_path / "r", "--hex27")
    assert status == BAD_INPUT
    assert "hex27" in err
    assert not (tmp_path / "r").exists()
    with pytest.raises(InputError, match="base 'best' .* element 'hex27'"):
        dataclasses.replace(HEX27, base="best").problem(thick)


def test_the_learned_element_is_there_once_and_called_so(program, thick, tmp_path):
    thick = thick.with_changes(time={"integrator": "backward-euler"})
    own = pc.learned_coarse(thick)
    for scene, learned in ((own, False), (own, True), (thick, True)):
        cases = cases_for(scene, learned=learned, second_order=True)
        (case,) = (case for case in cases if case.label == LEARNED.label)
        assert case.problem(scene).element == "hex8-learned"
        assert case.plain == (scene is own)
        assert ("coarse PD" in labels(cases)) == (scene is thick)
        assert labels(cases).count(f"{LEARNED.label}, generalised-alpha") == 1
    found = {row.label: row for row in pc.compare(own, 2).rows}
    error, zero = (found[x].rms_error for x in ("learned coarse PD", "best coarse PD"))
    assert found["best coarse PD"].omega == 0.0
    assert found["learned coarse PD"].omega == pytest.approx(100 * (1 - (error / zero) ** 2))
    (tmp_path / "scene.toml").write_text(thick.with_changes(solver={"element": "hex27"}).to_toml())
    for command in ("simulate", "compare"):  # it has not all nodes
        arguments = ("--learned", "-o", tmp_path / "out")
        status, _, err = program(command, tmp_path / "scene.toml", *arguments)
        assert status == BAD_INPUT
        assert "27" in err
        assert not (tmp_path / "out").exists()


def test_models_keep_the_reference_that_they_learned_from(thick):
    pytest.importorskip("torch_geometric")
    plain = cases_for(thick, ["torsion-as-published"], hex27=True)
    assert labels(plain) == [
        "fine PD", "intermediate PD", "coarse PD", "coarse Newton", "best coarse PD",
        "hybrid torsion-as-published", "coarse PD, hex27",
    ]  # fmt: skip
    trained = cases_for(thick, [MODEL])
    assert labels(trained) == [
        "fine PD as trained", "intermediate PD", "coarse PD", "coarse Newton", "best coarse PD",
        "coarse PD as trained", f"hybrid {MODEL}",
    ]  # fmt: skip
    for label, refine in (("fine PD as trained", 4), ("coarse PD as trained", 1)):
        (case,) = (case for case in trained if case.label == label)
        assert case.problem(thick).element == "hex8-bubble-mean"
        assert case.problem(thick).refine == refine
    scene = pc.best_coarse(thick)
    plain = cases_for(scene, ["torsion-as-published"])
    assert plain[:-1] == CASES
    assert (plain[-1].label, plain[-1].base) == ("hybrid torsion-as-published", "plain")
    with pytest.raises(InputError, match="best, plain"):
        cases_for(scene, [MODEL, "torsion-as-published"])


@pytest.mark.parametrize(
    "changes", [{"solver": "newton"}, {"refine": 2}, {"base": "plain"}, {"element": "hex27"}]
)
def test_a_case_does_not_ignore_what_its_corrector_is_not_for(thick, changes):
    pytest.importorskip("torch_geometric")
    case = Case("odd", "pd", 1, "best", MODEL)
    with pytest.raises(InputError, match=f"odd: .*{MODEL}.* 'best'"):
        case_stepper(thick, dataclasses.replace(case, **changes))


def test_a_corrector_of_a_best_coarse_model_that_is_not_there_is_refused_at_once(
    program, thick, tmp_path
):
    pytest.importorskip("torch_geometric")
    (tmp_path / "scene.toml").write_text(thick.with_changes(solver={"element": "hex27"}).to_toml())
    arguments = ("-o", tmp_path / "r", "--model", MODEL, "--no-figures")
    status, _, err = program("compare", tmp_path / "scene.toml", *arguments)
    assert status == BAD_INPUT
    assert f"models {MODEL}: " in err
    assert not (tmp_path / "r").exists()
    own = pc.best_coarse(thick)  # has none beside its own, which is as good
    assert labels(cases_for(own, [MODEL]))[-1] == f"hybrid {MODEL}"


def test_large_numbers_have_no_powers_of_ten():
    assert [report.three_digits(x) for x in (0.01234, 999.4, 999.6, 12345.6)] == [
        "0.0123", "999", "1000", "12346"
    ]  # fmt: skip


def test_a_row_whose_corrections_are_all_refused_is_the_base_and_says_so(stiff, tmp_path):
    pytest.importorskip("torch_geometric")
    coarse, hybrid = cases_for(stiff, [MODEL])[5:]
    found = pc.compare(stiff, cases=(coarse, hybrid))
    assert found.rows[1].refused_frames == 2
    name = f"hybrid {MODEL} (all refused)"
    assert [line["solver"] for line in report.table(found)] == ["coarse PD as trained", name]
    assert any(f"{hybrid.label}: " in note and "2 of 2" in note for note in notes(found))
    assert f"<td>{name}</td>" in report.write_report(found, tmp_path, draw=False).read_text()
    np.testing.assert_array_equal(
        found.runs[hybrid.label].positions, found.runs[coarse.label].positions
    )
    for count, label in ((1, f"{hybrid.label} (1 of 2 refused)"), (0, hybrid.label)):
        fewer = (found.rows[0], dataclasses.replace(found.rows[1], refused_frames=count))
        assert report.table(dataclasses.replace(found, rows=fewer))[1]["solver"] == label
    open_ = pc.compare(stiff, cases=cases_for(stiff, [MODEL], gate=False)[-1:])
    assert (open_.rows[0].label, open_.rows[0].refused_frames) == (f"{hybrid.label}, no gate", 0)


def test_refused_corrections_are_told_with_their_numbers_and_meanings():
    outside, energy = Reason.OUTSIDE, Reason.ENERGY
    assert refused_corrections([]) == refused_corrections([0.0, 0.0]) == ""
    told = refused_corrections([0.0, outside, energy, outside])
    assert "3 of 4" in told
    assert told.index(f"2 because {outside.meaning}") < told.index(f"1 because {energy.meaning}")


@pytest.mark.parametrize("length", [20, 60, 160])
def test_no_text_of_a_plot_leaves_it_and_axes_keep_their_height(tmp_path, monkeypatch, length):
    pytest.importorskip("matplotlib")
    agg = pytest.importorskip("matplotlib.backends.backend_agg")
    from pdcorrect.figures import curves

    seen = []
    monkeypatch.setattr(curves, "_save", lambda figure, output: seen.append(figure))
    times = np.linspace(0.0, 1.0, 3)
    names = [f"{k:02d} {'hybrid ' * 40}"[:length] for k in range(12)]
    curves.plot_error_over_time(dict.fromkeys(names, 1e-3 * times), times, "a.png")
    curves.plot_error_against_time({n: (0.1 * k + 1, 2.0**-k) for k, n in enumerate(names)}, "b")
    curves.plot_error_over_time({"one": 1e-3 * times}, times, "c.png")
    for figure in seen:
        agg.FigureCanvasAgg(figure)
        figure.draw_without_rendering()
    *long, short = (figure.axes[0].get_window_extent().height for figure in seen)
    assert min(long) > 0.9 * short
    for figure in seen:
        drawn = figure.get_tightbbox().transformed(figure.dpi_scale_trans)
        assert (drawn.min >= figure.bbox.min - 1).all()
        assert (drawn.max <= figure.bbox.max + 1).all()


def test_names_are_folded_on_a_terminal_only(thick, monkeypatch, capsys):
    label = "hybrid torsion-as-published-other-mass"
    case = dataclasses.replace(CASES[2], label=label)
    found = pc.compare(thick, 1, (CASES[2], case))
    slow = [dataclasses.replace(row, seconds_a_frame=1.2346) for row in found.rows]
    found = dataclasses.replace(found, rows=tuple(slow))
    monkeypatch.setenv("COLUMNS", "78")

    def names():
        _print_table(found)
        lines = capsys.readouterr().out.splitlines()[5:]
        assert " 1235 " in lines[0]
        return [line.strip().split("  ")[0] for line in lines if line.strip()]

    assert names() == [label]
    monkeypatch.setenv("FORCE_COLOR", "1")  # as a terminal
    monkeypatch.setenv("TERM", "dumb")
    folded = names()
    assert len(folded) > 1
    assert "".join(folded) == label.replace(" ", "")


def test_series_of_rows_that_are_gone_are_deleted_or_told(program, thick, tmp_path):
    again = dataclasses.replace(CASES[2], label="coarse, PD")  # of the same file name
    first = pc.compare(thick, 1, CASES[1:3])
    report.write_series(first, tmp_path)
    (tmp_path / "vtu" / "mine.vtu").write_text("")
    second = pc.compare(thick, 1, CASES[2:3])
    report.write_series(second, tmp_path)
    written = report.write_series(pc.compare(thick, 1, (CASES[2], again)), tmp_path / "again")
    assert [path.name for path in written] == ["coarse-pd.pvd", "coarse-pd-again.pvd"]
    assert {path.name for path in (tmp_path / "vtu").iterdir()} == {
        "coarse-pd.pvd", "coarse-pd_0000.vtu", "coarse-pd_0001.vtu", "mine.vtu"
    }  # fmt: skip
    (tmp_path / "scene.toml").write_text(thick.to_toml())
    command = ("compare", tmp_path / "scene.toml", "--frames", 1, "--no-figures", "-o")
    assert f"{tmp_path / 'vtu'} " in program(*command, tmp_path)[1]
    assert "vtu" not in program(*command, tmp_path / "new")[1]


# --- errors to the converged motion ------------------------------------------------------


def test_errors_to_the_converged_motion_come_first(program, tmp_path, monkeypatch):
    monkeypatch.setenv("PDCORRECT_CACHE", str(tmp_path / "cache"))
    time = {"integrator": "generalised-alpha", "step": 1e-3, "frames": 1}
    scene = beam((2, 2, 2), time=time)
    (tmp_path / "scene.toml").write_text(scene.to_toml())
    folder = tmp_path / "report"
    options = ("--converged-error", "--estimate-error")
    status, out, _ = program("compare", tmp_path / "scene.toml", "-o", folder, *options)
    assert status == 0
    with (folder / "report.csv").open() as file:
        rows = {r["label"]: r for r in csv.DictReader(file)}
    assert HEX27.label in rows
    errors = {label: float(row["relative_error"]) for label, row in rows.items()}
    assert max(errors, key=errors.get).startswith("coarse ")
    assert 0 < errors["fine best PD"] < errors["best coarse PD"] < errors["coarse PD"] < 1
    truth = pc.converged(scene)
    own = pc.rollout(pc.ProjectiveDynamics(pc.discretise(scene)))
    assert errors["coarse PD"] == pytest.approx(pc.metrics.relative_error(own, truth), rel=1e-9)
    text = (folder / "index.html").read_text()
    assert re.findall("<th>(.*?)</th>", text)[:4] == ["solver", "estimated", "error", "RMS mm"]
    for label in ("coarse PD", "best coarse PD"):
        assert 0.5 < float(rows[label]["estimated_error"]) / errors[label] < 2.0
    assert not rows["fine best PD"]["estimated_error"]
    record = json.loads((folder / "report.json").read_text())
    assert {"time_error", "mesh_error"} <= set(record["converged"])
    shown = f"{report.three_digits(100 * errors['coarse PD'])} %"
    assert re.search(f"<td>coarse PD</td>.*<td>{shown}</td>", text)
    assert shown in out
    assert (folder / "error_over_time.png").stat().st_size > 5000


def test_a_scene_of_another_integrator_is_run_by_the_second_order_one_too(thick):
    scene = thick.with_changes(time={"integrator": "backward-euler"})
    known = cases_for(scene, hex27=True)
    cases = cases_for(scene, hex27=True, second_order=True)
    assert cases[: len(known)] == known
    more = cases[len(known) :]
    assert [(c.base, c.element) for c in more] == [("enhanced", None), ("plain", "hex27")]
    for case in more:
        assert not case.plain
        assert case.problem(scene).scene.time.integrator == "generalised-alpha"
    itself = scene.with_changes(time={"integrator": "generalised-alpha"})
    assert cases_for(itself, hex27=True, second_order=True) == cases_for(itself, hex27=True)


def test_scenes_of_27_nodes_and_cases_that_fail_have_errors_too(thick, monkeypatch, tmp_path):
    monkeypatch.setenv("PDCORRECT_CACHE", str(tmp_path / "cache"))
    scene = thick.with_changes(time={"integrator": "generalised-alpha", "step": 1e-3})
    truth = pc.converged(scene)
    scene = scene.with_changes(solver={"element": "hex27"})
    found = pc.compare(scene, cases=CASES[2:3], converged=truth)
    assert 0 < found.rows[0].relative_error < 0.5
    assert found.errors_over_time()["coarse PD"].shape == truth.times.shape
    failed = dataclasses.replace(found, failures={"other": "why"})
    last = report.table(failed)[-1]
    assert (last["solver"], last["error"], last["RMS mm"]) == ("other", "failed", "")
    assert pc.compare(scene, cases=CASES[2:3]).rows[0].relative_error is None


# --- correctors --------------------------------------------------------------------------


def test_compare_with_a_corrector_adds_it_and_the_model_that_it_corrects(program, tmp_path):
    pytest.importorskip("torch_geometric")
    scene, folder = EXAMPLES / "unseen_cross.toml", tmp_path / "report"
    command = ("compare", scene, "-o", folder, "--frames", 4, "--no-figures")
    assert program(*command, "--model", MODEL)[0] == 0
    rows = {r["label"]: r for r in csv.DictReader((folder / "report.csv").open())}
    coarse = ["coarse PD", "coarse Newton", "best coarse PD", "coarse PD as trained",
              f"hybrid {MODEL}"]  # fmt: skip
    assert list(rows) == [*coarse, "intermediate PD", "fine PD as trained"]
    errors = [float(rows[name]["rms_error"]) for name in coarse]
    assert errors[4] < 0.5 * errors[3] < 0.5 * errors[0]
    assert [rows[name]["refused_frames"] for name in coarse] == ["", "", "", "", "0"]
    assert rows[coarse[4]]["solver"] == "hybrid"
    record = json.loads((folder / "report.json").read_text())
    about = record["models"][coarse[4]]
    assert (about["base"], about["dataset"].split("+")[0]) == ("best", MODEL)


def test_correctors_of_one_name_are_told_apart_and_cases_of_one_label_refused(tmp_path):
    pytest.importorskip("torch_geometric")
    models = [str(saved(tmp_path / name / "model", problems((3, 1, 1)))) for name in ("one", "two")]
    assert labels(cases_for(beam((2, 1, 1)), models))[-2:] == [
        "hybrid one/model",
        "hybrid two/model",
    ]
    with pytest.raises(InputError, match="coarse PD, coarse PD"):
        pc.compare(beam((2, 1, 1)), cases=CASES[2:3] * 2)


def test_bases_are_known_and_comparisons_of_no_frames_refused():
    with pytest.raises(InputError, match="frames = 0"):
        pc.compare(beam((2, 1, 1)), 0)
    scene, case = beam((2, 1, 1)), CASES[1]
    with pytest.raises(InputError, match="base 'worst'"):
        dataclasses.replace(case, base="worst").problem(scene)
    assert dataclasses.replace(case, base="best").problem(scene).element == "hex8-bubble"
    own = dataclasses.replace(case, base="enhanced").problem(scene)
    assert (own.element, own.refine) == (pc.best_coarse(scene).solver.element, 2)


# --- whole reports and what fails --------------------------------------------------------


def test_compare_writes_its_report(program, tmp_path):
    scene = tmp_path / "cross.toml"
    scene.write_text(beam((4, 2, 2), solver={"tolerance": 1e-4}).to_toml())
    Image = pytest.importorskip("PIL.Image")
    folder = tmp_path / "report"
    status, out, _ = program("compare", scene, "-o", folder, "--frames", 2)
    assert status == 0
    rows = {r["label"]: r for r in csv.DictReader((folder / "report.csv").open())}
    best = ["best coarse PD", "intermediate PD", "fine best PD"]
    assert list(rows) == ["coarse PD", "coarse Newton", *best]
    assert float(rows["fine best PD"]["rms_error"]) == 0
    errors = [float(rows[k]["rms_error"]) for k in ("coarse PD", "intermediate PD")]
    assert errors[0] > 2 * errors[1] > 0
    assert float(rows["coarse PD"]["omega"]) == 0
    assert float(rows["intermediate PD"]["omega"]) == pytest.approx(
        100 * (1 - (errors[1] / errors[0]) ** 2)
    )
    record = json.loads((folder / "report.json").read_text())
    assert 0 < record["solver_error"] < 1e-2 * errors[0]
    assert all(row["unusual_frames"] == 0 for row in record["rows"])
    assert record["environment"]["threads"]
    text = (folder / "index.html").read_text()
    assert not re.search("<script|https?://", text)
    for name in (
        "motion.gif", "comparison.png", "overlay.png", "node.png", "energy.png",
        "error_over_time.png", "error_against_time.png",
    ):  # fmt: skip
        assert base64.b64encode((folder / name).read_bytes()).decode() in text
        assert (folder / name).stat().st_size > 5000
    with Image.open(folder / "motion.gif") as film:
        assert film.n_frames == 3
    for label in rows:
        assert label in out
        assert f"<td>{label}</td>" in text


def test_simulate_writes_a_page_about_its_run(program, tmp_path):
    pytest.importorskip("pyvista")
    scene, folder = tmp_path / "scene.toml", tmp_path / "report"
    probes = [{"name": "tip <1>", "point": [0.16, 0.0, 0.0]}]
    scene.write_text(beam((4, 2, 2), 0.04, name="a & b", probes=probes).to_toml())
    output = ("-o", tmp_path / "run.h5", "--frames", 2)
    assert program("simulate", scene, *output, "--report", folder)[0] == 0
    text = (folder / "index.html").read_text()
    assert "<h1>a &amp; b</h1>" in text
    assert "probe tip &lt;1&gt;" in text
    for name in ("motion.gif", "probe_0.png", "energy.png"):
        assert base64.b64encode((folder / name).read_bytes()).decode() in text
    (folder / "index.html").unlink()
    assert program("simulate", scene, *output, "--resume", "--report", folder)[0] == 0
    assert (folder / "index.html").exists()


def failing_after_a_step(monkeypatch, kind, nodes, element="hex8"):
    """Have steppers of a class fail in their second step on such meshes."""
    step = kind.__call__

    def fails_second(self, state, *others, **named):
        result = step(self, state, *others, **named)
        fails = len(state.positions) in nodes and self.problem.element == element
        if fails and state.time > 0.0:
            return dataclasses.replace(result, status=pc.Status.ITERATION_LIMIT)
        return result

    monkeypatch.setattr(kind, "__call__", fails_second)


def nodes_of(scene, refine):
    return len(pc.discretise(scene, refine).positions)


@pytest.mark.parametrize("failing", ["coarse PD", "intermediate PD"])
def test_compare_goes_on_after_a_case_that_fails(
    program, scene_file, tmp_path, monkeypatch, failing
):
    refine = {case.label: case.refine for case in CASES}[failing]
    nodes = nodes_of(pc.Scene.load(scene_file), refine)
    failing_after_a_step(monkeypatch, pc.ProjectiveDynamics, {nodes})
    folder = tmp_path / "report"
    drawn = failing == "coarse PD"
    status, out, err = program(
        "compare", scene_file, "-o", folder, "--figures" if drawn else "--no-figures"
    )
    assert (status, err) == (FAILED, "")
    rows = {r["label"]: r for r in csv.DictReader((folder / "report.csv").open())}
    others = ["coarse PD", "coarse Newton", "best coarse PD", "intermediate PD", "fine best PD"]
    assert list(rows) == [*(label for label in others if label != failing), failing]
    assert [row["failure"] != "" for row in rows.values()] == [False] * 4 + [True]
    record = json.loads((folder / "report.json").read_text())
    assert list(record["failures"]) == [failing]
    assert (record["solver_error"] is None) == (failing == "coarse PD")
    text = (folder / "index.html").read_text()
    assert f"<td>{failing}</td><td>failed</td>" in text
    assert f"{failing} failed: frame 2" in " ".join(out.split())
    assert not drawn or (folder / "comparison.png").stat().st_size > 5000


def test_compare_ends_where_its_reference_fails(program, scene_file, tmp_path, monkeypatch):
    nodes = nodes_of(pc.Scene.load(scene_file), 4)
    failing_after_a_step(monkeypatch, pc.ProjectiveDynamics, {nodes}, "hex8-enhanced")
    status, _, err = program("compare", scene_file, "-o", tmp_path / "report")
    assert status == FAILED
    assert "frame 2 (t = 0.02 s) failed" in err
    assert not (tmp_path / "report" / "index.html").exists()


def test_a_report_of_a_reference_alone_has_no_plots_of_errors(tmp_path, monkeypatch):
    scene = beam((4, 2, 1), time={"frames": 2})
    coarse = {nodes_of(scene, refine) for refine in (1, 2)}
    for kind in (pc.ProjectiveDynamics, pc.Newton):
        failing_after_a_step(monkeypatch, kind, coarse)
    found = pc.compare(scene, cases=CASES)
    assert [row.label for row in found.rows] == ["fine PD"]
    assert list(found.failures) == ["coarse Newton", "coarse PD", "intermediate PD"]
    text = report.write_report(found, tmp_path).read_text()
    assert 'id="comparison"' in text
    assert 'id="error_' not in text
    assert not list(tmp_path.glob("error_*.png"))


def test_a_case_that_cannot_be_set_up_has_failed(monkeypatch):
    scene = beam((2, 1, 1), time={"frames": 1})
    make = case_stepper

    def refuses(scene, case):
        if case.solver == "newton":
            raise pc.errors.ConvergenceError("no factor.")
        return make(scene, case)

    monkeypatch.setattr(compare_module, "case_stepper", refuses)
    assert pc.compare(scene).failures == {"coarse Newton": "no factor."}


def test_compare_without_figures_needs_no_view_extra(program, scene_file, tmp_path, monkeypatch):
    for module in ("pyvista", "matplotlib"):
        monkeypatch.setitem(sys.modules, module, None)
    status, _, _ = program(
        "compare", scene_file, "-o", tmp_path / "r", "--frames", 2, "--no-figures"
    )
    assert status == 0
    assert not list((tmp_path / "r").glob("*.png"))
    status, _, err = program("compare", scene_file, "-o", tmp_path / "r2", "--frames", 2)
    assert status == BAD_INPUT
    assert "pdcorrect[view]" in err


def test_a_name_that_reads_nan_survives_the_report(tmp_path):
    scene = beam((2, 1, 1), name="NaN study", time={"frames": 1})
    comparison = pc.compare(scene, cases=CASES[2:3])
    record = json.loads(report.to_json(comparison))
    assert "NaN study" in record["scene"]
    assert record["rows"][0]["omega"] is None
    with pytest.raises(InputError, match="cases"):
        pc.compare(scene, cases=())


def test_frames_that_needed_a_fallback_are_reported(monkeypatch):
    real = pc.Newton.__call__
    monkeypatch.setattr(
        pc.Newton,
        "__call__",
        lambda self, *args: dataclasses.replace(real(self, *args), status=pc.Status.SUBSTEPPED),
    )
    comparison = pc.compare(beam((3, 1, 1), time={"frames": 2}))
    assert comparison.solver_error is None
    assert [row.unusual_frames for row in comparison.rows if row.solver == "newton"] == [2]
    assert any("coarse Newton: 2 frames" in note for note in notes(comparison))
