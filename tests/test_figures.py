"""Pictures: not blank, nothing clipped, equal runs look equal, wrong requests are named."""

from dataclasses import replace

import imageio.v3 as imageio
import numpy as np
import pytest

import pdcorrect as pc
from conftest import cross
from pdcorrect import figures
from pdcorrect.errors import InputError, OutputError

WHITE = 255


@pytest.fixture(scope="module")
def runs():
    return [pc.rollout(pc.ProjectiveDynamics(pc.discretise(cross(), refine=k)), 6) for k in (1, 2)]


def panels(path, count):
    """The panels of a picture without the strip below."""
    image = imageio.imread(path)[..., :3]
    image = image[: figures._PANEL[1]]
    return np.split(image, count, axis=1)


def body(panel):
    """Pixels that are neither white nor grey: a coloured body."""
    pixels = panel.astype(int)
    return np.ptp(pixels, axis=-1) > 40


def test_two_equal_runs_give_equal_panels(runs, tmp_path):
    figures.render([runs[0], runs[0]], tmp_path / "x.png", labels=["same", "same"])
    left, right = panels(tmp_path / "x.png", 2)
    corner = slice(int(0.75 * left.shape[0]), None), slice(left.shape[1] // 2, None)
    different = (left != right).any(axis=-1)
    different[corner] = False  # the length scale is drawn once
    assert different.mean() < 1e-3
    assert body(left).mean() > 0.1


@pytest.mark.parametrize("colour", ["displacement", "error", None])
def test_bodies_are_inside_their_panels(runs, tmp_path, colour):
    path = figures.render(
        runs, tmp_path / "x.png", colour=colour, reference=runs[1], labels=["a", "b"], frame=3
    )
    for panel in panels(path, 2):
        inside = body(panel)
        assert inside.any() or colour == "error"
        for edge in (inside[:4], inside[-4:], inside[:, :4], inside[:, -4:]):
            assert not edge.any()


def test_far_moving_bodies_are_never_clipped(runs, tmp_path):
    far = runs[0]
    shift = np.linspace(0, 3, len(far.times))[:, None, None] * [1.0, 0.5, -1.0]
    far = replace(far, positions=far.positions + shift)
    path = figures.render([far], tmp_path / "x.gif")
    frames = imageio.imread(path, index=None)[..., :3]
    assert len(frames) == len(far.times)
    for frame in frames:
        inside = body(frame[: figures._PANEL[1]])
        assert inside.any()
        for edge in (inside[:3], inside[-3:], inside[:, :3], inside[:, -3:]):
            assert not edge.any()


def test_larger_errors_are_brighter(runs, tmp_path):
    """The error colours follow the distance: a run against itself is all black."""
    figures.render([runs[0]], tmp_path / "far.png", colour="error", reference=runs[1])
    figures.render([runs[1]], tmp_path / "self.png", colour="error", reference=runs[1])
    far, near = (panels(tmp_path / n, 1)[0] for n in ("far.png", "self.png"))
    assert body(far).mean() > 0.05
    assert body(near).mean() < 0.01


def test_error_is_the_distance_at_shared_nodes(runs):
    coarse, fine = runs
    run, values = figures._distance(coarse, fine)
    here = pc.restrict(fine, to=coarse)
    np.testing.assert_allclose(
        values, np.linalg.norm(coarse.positions - here.positions, axis=2), atol=1e-15
    )
    assert run is coarse
    shown, values = figures._distance(fine, coarse)
    assert len(shown.points) == len(coarse.points) == values.shape[1]


def test_films_have_every_frame(runs, tmp_path):
    figures.render(runs[:1], tmp_path / "x.mp4", fps=10)
    film = imageio.imread(tmp_path / "x.mp4", plugin="FFMPEG")
    assert len(film) == len(runs[0].times)
    assert (film[0] != film[-1]).any()


def test_plots_are_drawn(runs, tmp_path):
    truth = pc.restrict(runs[1], to=runs[0])
    errors = {"coarse": pc.metrics.error_over_time(runs[0], truth)}
    made = [
        figures.plot_node_trajectories(
            runs, tmp_path / "a.png", node_point=[0.4, 0, 0], labels=["a", "b"]
        ),
        figures.plot_energy(runs, tmp_path / "b.png", labels=["a", "b"]),
        figures.plot_error_over_time(errors, truth.times, tmp_path / "c.png"),
        figures.plot_error_against_time({"a": (0.01, 1e-3), "b": (0.1, 1e-4)}, tmp_path / "d.png"),
    ]
    for path in made:
        image = imageio.imread(path)[..., :3]
        assert (np.ptp(image.astype(int), axis=-1) > 60).mean() > 1e-4  # coloured curves


def test_wrong_requests_are_named(runs, tmp_path):
    for call, words in (
        (lambda: figures.render(runs, tmp_path / "x.png", labels=["one"]), "1 labels for 2"),
        (lambda: figures.render(runs, tmp_path / "x.tiff"), "x.tiff"),
        (lambda: figures.render(runs, tmp_path / "x.png", frame=7), "-7 to 6"),
        (lambda: figures.render(runs, tmp_path / "x.png", colour="error"), "reference"),
        (lambda: figures.render(runs, tmp_path / "x.png", colour="age"), "'age'"),
        (lambda: figures.render([], tmp_path / "x.png"), "at least one"),
        (
            lambda: figures.plot_energy(
                [replace(runs[0], stats={})], tmp_path / "x.png", labels=["a"]
            ),
            "elastic_energy",
        ),
    ):
        with pytest.raises(InputError, match=words):
            call()
    with pytest.raises(OutputError, match="does not exist"):
        figures.render(runs, tmp_path / "nowhere" / "x.png")
    assert not list(tmp_path.iterdir())


def test_a_missing_library_says_what_to_install(runs, tmp_path, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "pyvista", None)
    with pytest.raises(pc.errors.MissingExtraError, match=r"pip install 'pdcorrect\[view\]'"):
        figures.render(runs, tmp_path / "x.png")


def test_the_probe_says_what_it_found():
    assert figures.check_offscreen().startswith("ok (")
    assert "libegl1" in figures.check_offscreen(timeout=0.01)
