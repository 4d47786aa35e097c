"""What `compare` shows: the best coarse model, its reference, refused correctors, VTU files."""

import csv
import dataclasses
import json
import shutil
import sys
from pathlib import Path

import meshio
import numpy as np
import pytest

import pdcorrect as pc
from conftest import beam
from pdcorrect.cli import compare as compare_cli
from pdcorrect.cli import main as cli
from pdcorrect.evaluation import refusal_text
from pdcorrect.evaluation import run_text
from pdcorrect.evaluation import report
from pdcorrect.evaluation.comparison_cases import HEX27, cases_for, without_best
from pdcorrect.errors import InputError

EXAMPLES = Path(__file__).parent.parent / "examples"
MODEL = "torsion-exact-compact"


@pytest.fixture
def thick():
    """A small beam that is nowhere one cell thick."""
    return beam((3, 2, 2), time={"frames": 2})


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
    assert found.runs["fine best PD"].attributes["element"] == "hex8-bubble-mean"
    by_hand = pc.restrict(
        pc.rollout(pc.ProjectiveDynamics(pc.discretise(pc.best_coarse(thick), 4))),
        to=pc.discretise(thick),
    )
    own = pc.rollout(pc.ProjectiveDynamics(pc.coarse_model(thick, "best")))
    row = found.rows[2]
    assert row.rms_error == pytest.approx(pc.metrics.rms_error(own, by_hand), rel=1e-9)
    assert row.rms_error < 0.5 * found.rows[0].rms_error
    assert found.rows[0].omega == 0.0  # the zero is the scene's own coarse run
    told = " ".join(report.notes(found))
    assert "is not the truth: it is the scene with each cell cut 4×4×4" in told
    assert "best coarse PD: element hex8-bubble-mean, mass averaged, as the reference" in told


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"solver": {"element": "hex8-bubble-mean", "mass": "averaged"}}, "are those of the best"),
        ({"solver": {"element": "hex27"}}, "27-node elements"),
        ({"material": {"energy": "volume-only"}}, "nothing resists"),
    ],
)
def test_scenes_without_a_best_coarse_model_say_why(thick, changes, words):
    scene = thick.with_changes(**changes)
    assert words in without_best(scene)
    assert cases_for(scene) == pc.evaluate.CASES
    (found,) = [
        note
        for note in report.notes(pc.compare(scene, 1, pc.evaluate.CASES[2:3]))
        if "no row of the best coarse model" in note
    ]
    assert words in found


def test_the_same_element_with_another_mass_is_another_model(thick):
    scene = thick.with_changes(solver={"element": "hex8-bubble-mean"})
    assert without_best(scene) is None
    assert "best coarse PD" in labels(cases_for(scene))


def test_27_node_elements_are_measured_on_the_coarse_nodes(program, thick, tmp_path):
    (tmp_path / "scene.toml").write_text(thick.to_toml())
    arguments = ("-o", tmp_path / "r", "--hex27", "--no-figures")
    status, out, _ = program("compare", tmp_path / "scene.toml", *arguments)
    assert status == 0
    rows = {r["label"]: r for r in csv.DictReader((tmp_path / "r" / "report.csv").open())}
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
    assert "it has 175 nodes" in out
    record = json.loads((tmp_path / "r" / "report.json").read_text())
    assert [case["element"] for case in record["cases"]] == [None] * 5 + ["hex27"]


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
    assert status == cli.BAD_INPUT
    assert "leave the option out" in err
    assert not (tmp_path / "r").exists()
    with pytest.raises(InputError, match="element 'hex27' with base 'best'"):
        dataclasses.replace(HEX27, base="best").problem(thick)


def test_models_keep_the_reference_that_they_learned_from(thick):
    pytest.importorskip("torch_geometric")
    plain = cases_for(thick, ["torsion-as-published"], hex27=True)
    assert labels(plain) == [
        "fine PD", "intermediate PD", "coarse PD", "coarse Newton", "best coarse PD",
        "hybrid torsion-as-published", "coarse PD, hex27",
    ]  # fmt: skip
    best = cases_for(thick, [MODEL])
    assert best == pc.evaluate.cases_with([MODEL])
    assert labels(best).count("best coarse PD") == 1


def test_errors_from_another_element_than_the_references_are_told(thick):
    cases = (*pc.evaluate.CASES[:1], *pc.evaluate.CASES[2:3], cases_for(thick)[4])
    told = " ".join(report.notes(pc.compare(thick, cases=cases)))
    assert "best coarse PD: element hex8-bubble-mean, mass averaged, unlike the reference's" in told
    assert "(element hex8, mass lumped)" in told


def test_rows_unlike_the_reference_are_named_by_element_mass_and_total_mass(thick):
    told = report.notes(pc.compare(thick))
    (found,) = [note for note in told if "unlike the reference's" in note]
    assert found.startswith(
        "coarse PD, coarse Newton, intermediate PD: element hex8, mass lumped, unlike the "
        "reference's (element hex8-bubble-mean, mass averaged, total mass 0.096 kg)"
    )
    assert any("is the mesh's, the element's and the mass's." in note for note in told)


def test_rows_of_another_total_mass_and_the_row_of_the_right_one_are_told(thick):
    heavy = thick.with_changes(solver={"mass": "per-node"})
    right = dataclasses.replace(
        pc.evaluate.CASES[2], label="coarse PD, total mass", base="total-mass"
    )
    cases = (*pc.evaluate.CASES[:1], *pc.evaluate.CASES[2:], right)
    told = report.notes(pc.compare(heavy, cases=cases))
    (unlike,) = [note for note in told if "unlike the reference's" in note]
    assert unlike.startswith("coarse PD, coarse Newton: element hex8, mass per-node, total mass 0.")
    assert any("is the mesh's and the total mass's." in note for note in told)
    (what,) = [note for note in told if note.startswith("coarse PD, total mass: ")]
    assert what.endswith("By the mass rule per-node a mesh is the heavier the coarser it is.")
    told = " ".join(report.notes(pc.compare(thick, cases=cases)))
    assert "By the mass rule lumped meshes have one mass, so it changes nothing" in told


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"solver": "newton"}, "solver = 'newton', expected 'pd'"),
        ({"refine": 2}, "refine = 2, expected 1"),
        ({"base": "plain"}, "base = 'plain', expected 'best'"),
        ({"element": "hex27"}, "element = 'hex27', expected None"),
    ],
)
def test_a_case_does_not_ignore_what_its_corrector_is_not_for(thick, changes, words):
    pytest.importorskip("torch_geometric")
    case = pc.evaluate.Case("odd", "pd", 1, "best", MODEL)
    with pytest.raises(InputError, match=f"odd: {words}"):
        pc.evaluate.case_stepper(thick, dataclasses.replace(case, **changes))


def test_a_corrector_of_a_best_coarse_model_that_is_not_there_is_refused_at_once(
    program, thick, tmp_path
):
    pytest.importorskip("torch_geometric")
    (tmp_path / "scene.toml").write_text(thick.with_changes(solver={"element": "hex27"}).to_toml())
    arguments = ("-o", tmp_path / "r", "--model", MODEL, "--no-figures")
    status, _, err = program("compare", tmp_path / "scene.toml", *arguments)
    assert status == cli.BAD_INPUT
    assert f"model {MODEL}: corrects the best coarse model, and this scene has none: it has" in err
    assert not (tmp_path / "r").exists()
    own = pc.best_coarse(thick)  # has none beside its own, which is as good
    assert labels(cases_for(own, [MODEL]))[-1] == f"hybrid {MODEL}"


def test_a_foreign_integrator_is_told_of_in_the_notes(stiff):
    pytest.importorskip("torch_geometric")
    scene = stiff.with_changes(time={"integrator": "midpoint"})
    cases = cases_for(scene, [MODEL])[4:]
    (found,) = [n for n in report.notes(pc.compare(scene, 1, cases)) if "has never seen" in n]
    assert "trained on steps by backward-euler, and the scene's integrator is midpoint" in found
    assert not any("has never seen" in n for n in report.notes(pc.compare(stiff, 1, cases)))


def test_large_numbers_have_no_powers_of_ten():
    assert [run_text.three_digits(x) for x in (0.01234, 999.4, 999.6, 12345.6)] == [
        "0.0123", "999", "1000", "12346"
    ]  # fmt: skip


def test_a_row_whose_corrections_are_all_refused_says_so(stiff, tmp_path):
    pytest.importorskip("torch_geometric")
    coarse, hybrid = cases_for(stiff, [MODEL])[4:]
    found = pc.compare(stiff, cases=(coarse, hybrid))
    name = f"hybrid {MODEL} (all refused)"
    assert [line[0] for line in report.table(found)] == ["best coarse PD", name]
    text = report.write_report(found, tmp_path, draw=False).read_text()
    assert f"| {name} |" in text
    assert f"- hybrid {MODEL} is no corrected run" in text
    assert f"- hybrid {MODEL}: inputs (docs/corrector.md#graph-and-features) outside of" in text
    assert "in frame 1, in deviations of which the gate allows 1: stiffness by 7.11" in text
    assert ": stiffness by 7.11 at 100 % of the nodes" in text
    assert f"{refusal_text.PAGE}#{refusal_text.SECTIONS['features']}" in text
    np.testing.assert_array_equal(
        found.runs[hybrid.label].positions, found.runs["best coarse PD"].positions
    )


def test_some_refused_corrections_are_counted_beside_the_label(stiff):
    pytest.importorskip("torch_geometric")
    found = pc.compare(stiff, cases=cases_for(stiff, [MODEL])[5:])
    (label,) = found.runs
    run = found.runs[label]
    stats = {**run.stats, "refused": np.array([1.0, 0.0]), "gate": np.array([6.0, 0.0])}
    fewer = dataclasses.replace(
        found,
        rows=(dataclasses.replace(found.rows[0], refused_frames=1),),
        runs={label: dataclasses.replace(run, stats=stats)},
    )
    assert report.table(fewer)[0][0] == f"{label} (1 of 2 refused)"
    told = report.notes(fewer)
    assert f"{label}: 1 of 2 corrections were refused by the gate (1 by body)." in told
    assert not any("no corrected run" in note for note in told)
    none = dataclasses.replace(fewer, rows=(dataclasses.replace(found.rows[0], refused_frames=0),))
    assert report.table(none)[0][0] == label


def test_another_time_step_is_told_beside_that_of_the_training(stiff):
    pytest.importorskip("torch_geometric")
    scene = stiff.with_changes(time={"step": 2.0 * stiff.time.step})
    found = pc.compare(scene, 2, cases=cases_for(scene, [MODEL])[4:])
    label = f"hybrid {MODEL}"
    told = report.notes(found)
    assert f"{label}: 2 of 2 corrections were refused by the gate (2 by time step)." in told
    assert any(note.startswith(f"{label} is no corrected run") for note in told)
    (step,) = [note for note in told if note.startswith(f"{label}: the time step per cell size")]
    assert "is 2.0 times that of the training: 0.02 s, where the training has 0.01 s" in step
    (way,) = [note for note in told if note.startswith(f"{label}: expected")]
    link = f"{refusal_text.PAGE}#{refusal_text.SECTIONS['time step']}"
    assert f"expected a time step of 0.01 s ({link}); or, at your own risk, a gate" in way
    assert "without this bound, Gate(time_step=None), or none (--no-gate)." in way
    assert not any("that of the training" in n for n in report.notes(pc.compare(
        stiff, 1, cases=cases_for(stiff, [MODEL])[4:])))  # fmt: skip


def test_another_time_step_is_told_of_a_foreign_body_too(thick):
    pytest.importorskip("torch_geometric")
    scene = thick.with_changes(time={"step": 0.02})
    for gate, count in ((True, 1), (False, 0)):
        cases = pc.evaluate.cases_with([MODEL], gate=gate)[-1:]
        found = pc.compare(scene, 2, cases=cases)
        told = report.notes(found)
        label = cases[0].label
        both = f"{label}: 2 of 2 corrections were refused by the gate (2 by body and time step)."
        assert told.count(both) == count
        assert sum(note.startswith(f"{label}: measures of the body") for note in told) == count
        assert sum(": the time step per cell size is 5.0 times" in note for note in told) == count
        assert sum("Gate(body=None, time_step=None)" in note for note in told) == count


def test_of_two_models_that_refuse_the_same_it_is_told_once(thick, tmp_path):
    pytest.importorskip("torch_geometric")
    for name in ("one", "two"):
        shutil.copytree(EXAMPLES.parent / "models" / MODEL, tmp_path / name)
    cases = pc.evaluate.cases_with([str(tmp_path / name) for name in ("one", "two")])[-2:]
    told = report.notes(pc.compare(thick.with_changes(time={"step": 0.02}), 1, cases=cases))
    names = "hybrid one, hybrid two: "
    for words in ("measures of the body", "the time step per cell size", "expected a body"):
        assert [note for note in told if words in note] == [
            note for note in told if note.startswith(names + words)
        ]


def test_compare_writes_all_rows_for_paraview(program, thick, tmp_path):
    (tmp_path / "scene.toml").write_text(thick.to_toml())
    folder = tmp_path / "report"
    status, out, _ = program(
        "compare", tmp_path / "scene.toml", "-o", folder, "--vtu", "--hex27", "--no-figures"
    )
    assert status == 0
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


def test_labels_that_become_one_file_name_are_told_apart(thick, tmp_path):
    case = pc.evaluate.CASES[2]
    other = dataclasses.replace(case, label="coarse, PD")
    written = report.write_series(pc.compare(thick, 1, (case, other)), tmp_path)
    assert [path.name for path in written] == ["coarse-pd.pvd", "coarse-pd-again.pvd"]


def test_no_gate_without_a_model_is_refused(program, thick, tmp_path):
    (tmp_path / "scene.toml").write_text(thick.to_toml())
    status, _, err = program("compare", tmp_path / "scene.toml", "-o", tmp_path / "r", "--no-gate")
    assert status == cli.BAD_INPUT
    assert "--no-gate without --model" in err


def test_compare_with_a_model_and_no_torch_names_the_extra(program, thick, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    (tmp_path / "scene.toml").write_text(thick.to_toml())
    arguments = ("-o", tmp_path / "r", "--model", MODEL, "--no-figures")
    status, _, err = program("compare", tmp_path / "scene.toml", *arguments)
    assert status == cli.BAD_INPUT
    assert "pip install 'pdcorrect[learn]'" in err
    assert not (tmp_path / "r").exists()


def test_a_long_legend_stays_in_the_picture(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    from pdcorrect.figures import curves

    seen = []
    monkeypatch.setattr(curves, "_save", lambda figure, output: seen.append(figure))
    times = np.linspace(0.0, 1.0, 3)
    names = [f"hybrid of a model with a long name, number {k} (all refused)" for k in range(6)]
    curves.plot_error_over_time(dict.fromkeys(names, times), times, tmp_path / "a.png")
    curves.plot_error_over_time({name[:6] + name[-15:]: times for name in names}, times, "b.png")
    for figure in seen:
        (legend,) = figure.legends
        assert legend.get_window_extent().width <= figure.bbox.width
        assert len(figure.legends) == 1


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


def test_names_are_folded_at_spaces_and_hyphens_on_a_terminal_only(thick, monkeypatch, capsys):
    label = "hybrid torsion-as-published-total-mass"
    case = dataclasses.replace(pc.evaluate.CASES[2], label=label)
    found = pc.compare(thick, 1, (pc.evaluate.CASES[2], case))
    slow = [dataclasses.replace(row, seconds_a_frame=1.2346) for row in found.rows]
    found = dataclasses.replace(found, rows=tuple(slow))
    monkeypatch.setenv("COLUMNS", "78")

    def names():
        compare_cli._print_table(found)
        lines = capsys.readouterr().out.splitlines()[5:]
        assert " 1235 " in lines[0]
        return [line.strip().split("  ")[0] for line in lines if line.strip()]

    assert names() == [label]
    monkeypatch.setenv("FORCE_COLOR", "1")  # as a terminal
    monkeypatch.setenv("TERM", "dumb")
    folded = names()
    assert len(folded) > 1
    assert " ".join(folded).replace("- ", "-") == label


def test_refused_corrections_stand_above_a_body(stiff):
    pytest.importorskip("torch_geometric")
    found = pc.compare(stiff, cases=cases_for(stiff, [MODEL])[5:])
    (row,) = found.rows
    slow = dataclasses.replace(row, seconds_a_frame=12.3456)
    first, second, third = report._panel_label(found, slow).splitlines()
    assert first == f"hybrid {MODEL}, {row.nodes} nodes"
    assert second == "reference, 12346 ms a frame"
    assert third == "all refused"
    without = dataclasses.replace(row, refused_frames=0)
    assert len(report._panel_label(found, without).splitlines()) == 2


def test_a_vtu_folder_that_cannot_be_made_ends_the_program_before_its_work(
    program, thick, tmp_path, monkeypatch
):
    (tmp_path / "scene.toml").write_text(thick.to_toml())
    (tmp_path / "r").mkdir()
    (tmp_path / "r" / "vtu").write_text("")
    monkeypatch.setattr(pc.evaluate, "case_stepper", None)  # what works raises TypeError
    arguments = ("-o", tmp_path / "r", "--vtu", "--no-figures")
    status, _, err = program("compare", tmp_path / "scene.toml", *arguments)
    assert status == cli.FAILED
    assert "vtu: is a file: expected a folder" in err
    path, blocked = tmp_path / "run.h5", tmp_path / "r" / "vtu"
    status, _, err = program("simulate", tmp_path / "scene.toml", "-o", path, "--vtu", blocked)
    assert status == cli.FAILED
    assert "vtu: is a file: expected a folder" in err
    assert not path.exists()


def test_series_of_rows_that_are_gone_are_deleted_or_told(program, thick, tmp_path):
    first = pc.compare(thick, 1, pc.evaluate.CASES[1:3])
    report.write_series(first, tmp_path)
    (tmp_path / "vtu" / "mine.vtu").write_text("")
    second = pc.compare(thick, 1, pc.evaluate.CASES[2:3])
    report.write_series(second, tmp_path)
    assert {path.name for path in (tmp_path / "vtu").iterdir()} == {
        "coarse-pd.pvd", "coarse-pd_0000.vtu", "coarse-pd_0001.vtu", "mine.vtu"
    }  # fmt: skip
    (tmp_path / "scene.toml").write_text(thick.to_toml())
    command = ("compare", tmp_path / "scene.toml", "--frames", 1, "--no-figures", "-o")
    assert "is of an earlier run" in program(*command, tmp_path)[1]
    assert "is of an earlier run" not in program(*command, tmp_path / "new")[1]


def test_notes_name_the_solvers_rest_beside_two_plain_coarse_cases(thick):
    again = dataclasses.replace(pc.evaluate.CASES[2], label="coarse PD again")
    found = pc.compare(thick, 2, (*pc.evaluate.CASES[1:], again))
    assert any("the rest of their error is" in note for note in report.notes(found))
