"""Pictures: complete, comparable, labelled; and what is refused."""

import dataclasses
import sys
import warnings

import numpy as np
import pytest

import pdcorrect as pc
from conftest import beam
from motion import trajectory
from pdcorrect import figures
from pdcorrect.errors import InputError, MeshError, MissingExtraError, OutputError
from pdcorrect.fem.stress import von_mises
from pdcorrect.figures import curves, fields, panels
from pdcorrect.figures.obstacles import Surface, obstacles_of

pytest.importorskip("pyvista")
pytest.importorskip("matplotlib")
iio = pytest.importorskip("imageio.v3")

WIDTH = 400
"""Of a panel in most tests, pixels."""


@pytest.fixture(scope="module")
def run():
    return trajectory(frames=6)


@pytest.fixture(scope="module")
def fine():
    return trajectory(frames=6, refine=2, angle=1.2)


def drawn(path):
    return iio.imread(path)[..., :3].astype(int)


def paper(image):
    """Whether each pixel is white."""
    return (image == 255).all(axis=-1)


def bodies(image):
    """Whether each pixel is coloured, as bodies are and text and outlines are not."""
    return np.ptp(image, axis=-1) > 25


def panels_of(image, count):
    """The panels' columns without what lies above and below the bodies."""
    width = image.shape[1] // count
    return [image[:, k * width : (k + 1) * width] for k in range(count)]


def body_rows(image):
    """Rows between captions and legend: those of the tallest coloured block."""
    coloured = bodies(image).any(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], coloured.astype(int), [0]])))
    start, stop = max(edges.reshape(-1, 2), key=lambda ends: ends[1] - ends[0])
    return slice(start, stop)


def test_a_picture_shows_a_body_and_its_legend(run, tmp_path):
    path = figures.render(run, tmp_path / "a.png", labels=["one"], window=WIDTH)
    assert path == tmp_path / "a.png"
    image = drawn(path)
    assert image.shape[1] == WIDTH
    assert 0.08 < bodies(image).mean() < 0.6
    rows = body_rows(image)
    assert (~paper(image[: rows.start])).any()  # caption
    assert (~paper(image[rows.stop + 5 :])).any()  # legend
    assert not list(tmp_path.glob("*.part*"))
    columns = np.flatnonzero(bodies(image[rows]).any(axis=0))  # the body fills its panel
    assert columns[0] < 0.12 * WIDTH
    assert columns[-1] > 0.8 * WIDTH


@pytest.mark.parametrize("colour", ["displacement", None])
@pytest.mark.parametrize("frame", [0, 3, -1])
def test_no_body_touches_the_border_of_its_panel(run, tmp_path, colour, frame):
    """Even when stretched, turned and moved far from the origin."""
    far = np.array([40.0, -3.0, 7.0])
    moved, wild = (
        dataclasses.replace(run, positions=size * run.positions + far, points=far + run.points)
        for size in (1.0, 2.5)
    )
    path = figures.render(
        [wild, moved], tmp_path / "a.png", frame=frame, window=2 * WIDTH, colour=colour
    )
    image = drawn(path)
    rows = body_rows(image)
    for panel in panels_of(image[rows.start - 5 : rows.stop + 5], 2):
        assert bodies(panel).mean() > 0.02
        for margin in (panel[:5], panel[-5:], panel[:, :5], panel[:, -5:]):
            assert not bodies(margin).any()
        assert paper(panel[:, :4]).all()
        assert paper(panel[:, -4:]).all()


def test_equal_runs_give_equal_panels_and_others_do_not(run, tmp_path):
    other = trajectory(frames=6, angle=-0.9)
    image = drawn(figures.render([run, run, other], tmp_path / "a.png", window=3 * WIDTH))
    rows = body_rows(image)
    first, second, third = panels_of(image[rows], 3)
    assert first.shape[1] == WIDTH
    np.testing.assert_array_equal(first, second)
    assert (np.abs(first - third).max(axis=-1) > 30).mean() > 0.02


def test_panels_share_their_scale(run, tmp_path):
    """A body of half the size is drawn at half the size."""
    small = dataclasses.replace(run, positions=0.5 * run.positions, points=0.5 * run.points)
    image = drawn(figures.render([run, small], tmp_path / "a.png", frame=0, window=2 * WIDTH))
    widths = []
    for panel in panels_of(image[body_rows(image)], 2):
        columns = np.flatnonzero(bodies(panel).any(axis=0))
        widths.append(columns[-1] - columns[0])
    assert widths[1] / widths[0] == pytest.approx(0.5, abs=0.02)


def test_panels_share_their_colours(run, tmp_path):
    """What hardly moves is dark beside what moves far."""
    still = dataclasses.replace(run, positions=run.points + 0.05 * (run.positions - run.points))
    image = drawn(figures.render([run, still], tmp_path / "a.png", frame=4, window=2 * WIDTH))
    greens = [p[bodies(p)][:, 1].max() for p in panels_of(image[body_rows(image)], 2)]
    assert greens[0] > 180
    assert greens[1] < 100


def test_the_error_of_the_reference_is_nothing(run, fine, tmp_path):
    """Zero is the pale end of the map; on a finer mesh as well as on a coarser one."""
    for reference in (fine, run):
        image = drawn(
            figures.render(
                [run, fine], tmp_path / "a.png", colour="error", reference=reference,
                window=2 * WIDTH,
            )
        )  # fmt: skip
        panels = panels_of(image[body_rows(image)], 2)
        reds = [((p[..., 0] - p[..., 1] > 90) & bodies(p)).mean() for p in panels]
        wrong, right = reds if reference is fine else reds[::-1]
        assert wrong > 0.05
        assert right == 0


def test_errors_are_distances_at_coincident_nodes(run, fine):
    for shown, reference in ((run, fine), (fine, run)):
        frames = np.arange(7)
        body = fields.body_of(shown, frames, "error", reference, frames)
        points = [tuple(np.round(p, 9)) for p in body.run.points]
        assert len(points) == len(run.points)
        for run_here, positions in ((shown, body.run.positions), (reference, None)):
            place = {tuple(np.round(p, 9)): k for k, p in enumerate(run_here.points)}
            nodes = [place[p] for p in points]
            if positions is not None:
                np.testing.assert_array_equal(positions, run_here.positions[:, nodes])
                mine = run_here.positions[:, nodes]
            else:
                theirs = run_here.positions[:, nodes]
        np.testing.assert_allclose(body.values, np.linalg.norm(mine - theirs, axis=2))
        assert body.values.max() > 0.005


def test_runs_are_compared_at_equal_times(run):
    halved = trajectory(frames=9, step=0.01)
    common = figures._common_frames([run, halved])
    assert common.shape == (2, 5)
    np.testing.assert_allclose(run.times[common[0]], halved.times[common[1]], atol=1e-12)
    shifted = dataclasses.replace(run, times=run.times + 0.005)
    with pytest.raises(InputError, match="no time in common"):
        figures._common_frames([run, shifted])


def test_several_frames_lie_beside_or_below_each_other(run, tmp_path):
    strip = drawn(figures.render(run, tmp_path / "a.png", frame=[0, 3, 6], window=3 * WIDTH))
    table = drawn(figures.render([run, run], tmp_path / "b.png", frame=[0, 3, 6], window=2 * WIDTH))
    assert strip.shape[1] == 3 * WIDTH
    assert table.shape[1] == 2 * WIDTH
    assert table.shape[0] > 2.4 * (strip.shape[0] - 100)
    first, _, last = panels_of(strip[body_rows(strip)], 3)
    assert (first != last).mean() > 0.05


def test_films_hold_every_common_frame(run, tmp_path):
    short = trajectory(frames=4)
    path = figures.render([run, short], tmp_path / "a.gif", window=2 * 150, fps=20)
    film = iio.imread(path)
    assert film.shape[0] == 5
    assert film.shape[2] == 300
    assert iio.immeta(path)["duration"] == 50
    assert all((film[k] != film[k + 1]).any() for k in range(4))
    chosen = iio.imread(figures.render(run, tmp_path / "b.gif", frame=[0, 6], window=200))
    assert chosen.shape[0] == 2


def test_mp4(run, tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    path = figures.render(run, tmp_path / "a.mp4", window=201, fps=10)
    film = iio.imread(path, plugin="FFMPEG")
    assert film.shape[0] == 7
    assert film.shape[1] % 2 == film.shape[2] % 2 == 0
    assert (film[0] > 250).mean() > 0.4


def test_flat_still_and_tiny_cases_are_drawn(run, tmp_path):
    still = dataclasses.replace(run, positions=np.repeat(run.points[None], 7, axis=0))
    micro = dataclasses.replace(run, positions=1e-6 * run.positions, points=1e-6 * run.points)
    start = dataclasses.replace(
        run, positions=run.positions[:1], velocities=run.velocities[:1], times=run.times[:1],
        stats={},
    )  # fmt: skip
    for case in (still, micro, start):
        image = drawn(figures.render(case, tmp_path / "a.png", window=WIDTH))
        assert 0.08 < bodies(image).mean() < 0.6
    figures.render(run, tmp_path / "b.png", colour="error", reference=run, window=WIDTH)


def test_long_labels_stay_in_their_panel(run, tmp_path):
    long = "a label that is much longer than the panel above which it stands, by far\nand more"
    image = drawn(figures.render([run, run], tmp_path / "a.png", labels=[long, ""], window=800))
    caption = image[: body_rows(image).start - 40]
    assert (~paper(caption[:, :400])).any()
    assert paper(caption[:, 392:408]).all()


def test_bad_input_is_refused_by_name_and_value(run, fine, tmp_path):
    png, gif, two = tmp_path / "a.png", tmp_path / "a.gif", {"labels": ["a", "b"]}
    for draw, runs, output, named, told in (
        (figures.render, [], png, {}, "render"),
        (figures.render, [run, run], png, {"labels": ["a"]}, "1 labels for 2 runs"),
        (figures.render, run, tmp_path / "a.bmp2", {}, r"a\.bmp2"),
        (figures.render, run, tmp_path / "a", {}, "a: "),
        (figures.render, run, png, {"frame": 7}, "frame 7: .*-7 to 6"),
        (figures.render, run, png, {"frame": [0, -8]}, "frame -8: .*-7 to 6"),
        (figures.render, run, png, {"frame": []}, "frame"),
        (figures.render, run, png, {"colour": "speed"}, "'speed'"),
        (figures.render, run, png, {"camera": "north"}, "'north'"),
        (figures.render, run, png, {"section": ("w", 0.1)}, "'w'"),
        (figures.render, run, png, {"section": ("x", 9.0)}, "x = 9"),
        (figures.render, run, png, {"size": (300, 40)}, "300, 40"),
        (figures.render, run, png, {"colour": "error"}, "reference"),
        (figures.render, run, gif, {"fps": 0.0}, "fps"),
        (figures.render_overlay, [run], png, {"labels": ["a"]}, "1 run"),
        (figures.render_overlay, [run] * 7, png, {"labels": list("abcdefg")}, "7 runs"),
        (figures.render_overlay, [run, run], png, {"labels": ["a"]}, "1 labels for 2 runs"),
        (figures.render_overlay, [run, run], gif, two, r"a\.gif"),
        (figures.render_overlay, [run, run], png, {**two, "frame": 7}, "frame 7: .*-7 to 6"),
    ):
        with pytest.raises(InputError, match=told):
            draw(runs, output, **named)
    other = dataclasses.replace(fine, points=fine.points + 0.003)
    with pytest.raises(MeshError):
        figures.render(run, png, colour="error", reference=other)
    with pytest.raises(MeshError):
        figures.render_overlay([run, other], png, **two)
    assert not list(tmp_path.iterdir())


def test_runs_over_each_other_have_the_colours_of_the_legend(run, fine, tmp_path):
    away = dataclasses.replace(run, positions=run.positions + np.array([0.0, 0.0, 0.05]))
    three = [run, away, trajectory(frames=6, angle=-0.9)]
    image = drawn(
        figures.render_overlay(three, tmp_path / "a.png", labels=["1", "2", "3"], window=WIDTH)
    )
    legend = image[-40:, 150:].reshape(-1, 3)
    colours, counts = np.unique(legend, axis=0, return_counts=True)
    hued = [key for key in colours[counts > 10] if np.ptp(key) > 60]
    assert len(hued) == 2
    pixels = image[:-40].reshape(-1, 3)
    pixels = pixels[np.ptp(pixels, axis=1) > 90]
    near = [np.abs(pixels - key).max(axis=1) < 30 for key in hued]
    assert all(each.sum() > 100 for each in near)
    # all others are edges of lines: as the key is, with some white or grey
    hue = [np.argsort(key).tolist() for key in hued]
    others = np.unique(np.argsort(pixels[~np.any(near, axis=0)], axis=1), axis=0)
    assert all(order in hue for order in others.tolist())
    for label in ("1", "x" * 90):
        path = figures.render_overlay([run, run], tmp_path / "c.png", labels=[label, "last"])
        legend = drawn(path)[-60:]
        inked = np.flatnonzero((np.ptp(legend, axis=-1) > 100).any(axis=0))  # the key's strokes
        assert inked.max() > 0.3 * legend.shape[1]
        assert paper(legend[:, -5:]).all()
    # of a finer run, the coarse one's cells
    assert figures.render_overlay(
        [run, fine], tmp_path / "b.png", labels=["1", "2"], window=WIDTH
    ).exists()


def test_a_picture_has_the_size_that_is_asked_for(run, tmp_path):
    image = drawn(figures.render([run, run], tmp_path / "a.png", size=(501, 333)))
    assert image.shape[:2] == (333, 501)
    film = iio.imread(figures.render(run, tmp_path / "a.gif", size=(202, 260), frame=[0, 6]))
    assert film.shape[:3] == (2, 260, 202)


def height_over_width(image):
    rows = bodies(image)[: body_rows(image).stop]
    return np.ptp(np.flatnonzero(rows.any(1))) / np.ptp(np.flatnonzero(rows.any(0)))


@pytest.mark.parametrize(
    ("camera", "across", "up"),
    [("x", 1, 2), ("y", 0, 2), ("z", 0, 1), ((-90.0, 0.0), 0, 2), ((0.0, 0.0), 1, 2)],
)
def test_cameras_look_along_axes(run, tmp_path, camera, across, up):
    path = figures.render(run, tmp_path / "a.png", camera=camera, frame=0, window=WIDTH)
    length = np.ptp(run.points, axis=0)
    assert height_over_width(drawn(path)) == pytest.approx(length[up] / length[across], rel=0.06)


def test_warped_bodies_move_so_many_times_as_far(run, tmp_path):
    far = dataclasses.replace(run, positions=run.points + 3.0 * (run.positions - run.points))
    pictures = [
        drawn(figures.render(one, tmp_path / "a.png", colour=None, warp=warp, window=WIDTH))
        for one, warp in ((run, 3.0), (far, 1.0))
    ]
    np.testing.assert_array_equal(*pictures)


@pytest.mark.parametrize("towards", [1.0, -1.0])
def test_sections_leave_out_what_is_before_them(run, towards):
    axes = panels.camera_axes((0.0 if towards > 0 else 180.0, 0.0))
    body = fields.body_of(run, np.arange(7), "displacement").cut(0, 0.15, axes)
    left = body.run.points[body.run.cells].mean(axis=1)[:, 0]
    whole = run.points[run.cells].mean(axis=1)[:, 0]
    assert len(left) == (whole < 0.15).sum() if towards > 0 else (whole > 0.15).sum()
    assert (towards * left < towards * 0.15).all()
    moved = np.linalg.norm(body.positions - body.run.points, axis=2)
    np.testing.assert_allclose(body.values, moved)


@pytest.fixture(scope="module")
def fallen():
    """A cube in the air above and beside one obstacle of each shape, one of them moving."""
    obstacles = [
        {"shape": "plane", "point": [0.0, 0.0, -0.05], "normal": [0.0, 0.0, 1.0]},
        {"shape": "sphere", "centre": [0.2, 0.0, 0.0], "radius": 0.04},
        {"shape": "cylinder", "centre": [-0.1, 0.0, 0.0], "axis": [0.0, 1.0, 0.0], "radius": 0.03},
        {"shape": "box", "box": [[0.0, 0.2, 0.0], [0.1, 0.25, 0.1]],
         "motion": {"times": [0.0, 0.02], "displacement": [[0.0, 0.0, 0.0], [0.0, 0.0, 0.06]]}},
    ]  # fmt: skip
    scene = beam((2, 2, 2), 0.05, clamps=[], obstacles=obstacles)
    return pc.rollout(pc.ProjectiveDynamics(pc.discretise(scene)), frames=2)


def test_obstacles_are_drawn_where_they_are(fallen, tmp_path):
    names = {type(one.declared).__name__ for one in obstacles_of(fallen)}
    assert names == {"Plane", "Sphere", "Cylinder", "Box"}
    *_, box = (Surface(one, np.zeros(3), 0.2) for one in obstacles_of(fallen))
    for time, height in ((0.0, 0.0), (0.01, 0.03), (0.02, 0.06)):
        assert box.points(time)[:, 2].min() == pytest.approx(height)
    pc.save_trajectory(tmp_path / "run.h5", fallen)
    again = pc.load_trajectory(tmp_path / "run.h5")
    bare = dataclasses.replace(again, scene_toml="")
    size = {"size": (300, 300), "camera": "iso"}
    with_them = drawn(figures.render(again, tmp_path / "a.png", **size))
    without = drawn(figures.render(bare, tmp_path / "b.png", **size))
    grey = [(~paper(image) & ~bodies(image)).mean() for image in (without, with_them)]
    assert grey[1] > grey[0] + 0.1


def test_planes_and_endless_bars_stay_beside_the_body(fallen):
    middle = np.array([3.0, -2.0, 5.0])
    plane, _, bar, _ = (Surface(one, middle, 0.2) for one in obstacles_of(fallen))
    np.testing.assert_allclose(plane.points(0.0).mean(axis=0), [3.0, -2.0, -0.05], atol=1e-6)
    low, high = bar.points(0.0).min(axis=0), bar.points(0.0).max(axis=0)
    np.testing.assert_allclose(0.5 * (low + high), [-0.1, -2.0, 0.0], atol=1e-6)


def test_stress_and_volume_are_those_of_the_energy(fallen, tmp_path):
    stretched = dataclasses.replace(fallen, positions=fallen.positions * [1.1, 1.0, 1.0])
    frames = np.arange(3)
    ratios = fields.nodal_values(stretched, frames, "volume")
    np.testing.assert_allclose(ratios, 1.1, rtol=1e-3)
    found = fields.nodal_values(stretched, frames, "stress")
    cauchy = pc.stress(fallen.problem, stretched.positions[1]).nodal_cauchy
    np.testing.assert_allclose(found[1], von_mises(cauchy))
    for colour in ("stress", "volume"):
        image = drawn(figures.render(stretched, tmp_path / "a.png", colour=colour, window=WIDTH))
        assert bodies(image).mean() > 0.03
    with pytest.raises(InputError, match="no scene"):
        figures.render(
            dataclasses.replace(fallen, scene_toml="", problem=None), tmp_path / "b.png",
            colour="stress",
        )  # fmt: skip


def test_unwritable_outputs_and_missing_libraries_are_named(run, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    (tmp_path / "folder.png").mkdir()
    for path in (
        tmp_path / "none" / "a.png",
        tmp_path / "file" / "a.png",
        tmp_path / "folder.png",
    ):
        with pytest.raises(OutputError, match=path.name):
            figures.render(run, path, window=100)
    monkeypatch.setitem(sys.modules, "pyvista", None)
    with pytest.raises(MissingExtraError, match=r"pdcorrect\[view\]"):
        figures.render(run, tmp_path / "a.png")


# --- curves ----------------------------------------------------------------------------


def caught_lines(monkeypatch):
    """What the plots draw: (axis label, curve label, x, y)."""
    seen = []
    real = curves._save

    def save(figure, output):
        for axis in figure.axes:
            for line in axis.get_lines():
                seen.append((axis.get_ylabel(), line.get_label(), *line.get_data()))
        return real(figure, output)

    monkeypatch.setattr(curves, "_save", save)
    return seen


def test_node_curves_show_displacements_in_millimetres(run, fine, tmp_path, monkeypatch):
    seen = caught_lines(monkeypatch)
    place = run.points[7]
    path = figures.plot_node_trajectories(
        [run, fine], tmp_path / "a.png", node_point=place + 1e-4, labels=["coarse", "fine"]
    )
    assert drawn(path).std() > 5
    assert len(seen) == 6
    node = int(np.flatnonzero(np.abs(fine.points - place).max(axis=1) < 1e-9)[0])
    for axis in range(3):
        label, name, x, y = seen[2 * axis + 1]
        assert "xyz"[axis] in label
        assert "mm" in label
        assert name == "fine"
        np.testing.assert_array_equal(x, fine.times)
        moved = fine.positions[:, node, axis] - fine.points[node, axis]
        np.testing.assert_allclose(y, 1e3 * moved, atol=1e-12)


def test_energy_curves(run, tmp_path, monkeypatch):
    seen = caught_lines(monkeypatch)
    partial = dataclasses.replace(run, stats={"elastic_energy": run.stats["elastic_energy"]})
    figures.plot_energy([run, partial], tmp_path / "a.png", labels=["a", "b"])
    assert [line[1] for line in seen] == ["a", "b", "a", "a"]
    np.testing.assert_array_equal(seen[0][2], run.times[1:])
    np.testing.assert_array_equal(seen[2][3], run.stats["kinetic_energy"])
    np.testing.assert_allclose(seen[3][3][-1], run.stats["external_work"].sum())
    figures.plot_energy(run, tmp_path / "b.pdf", labels=["a"])
    assert (tmp_path / "b.pdf").read_bytes().startswith(b"%PDF")
    seen.clear()
    damped = {**run.stats, "damping_loss": np.full(len(run), 0.5)}
    figures.plot_energy(dataclasses.replace(run, stats=damped), tmp_path / "c.png", labels=["a"])
    assert len(seen) == 4
    np.testing.assert_allclose(seen[-1][3], 0.5 * np.arange(1, 1 + len(run)))
    with pytest.raises(InputError, match="kinetic_energy"):
        figures.plot_energy(dataclasses.replace(run, stats={}), tmp_path / "a.png", labels=["a"])


def test_error_curves(run, tmp_path, monkeypatch):
    seen = caught_lines(monkeypatch)
    errors = {"one": np.linspace(0, 0.002, 7), "two": np.linspace(0, 0.001, 7)}
    figures.plot_error_over_time(errors, run.times, tmp_path / "a.png")
    assert [line[1] for line in seen] == ["one", "two"]
    assert seen[0][3][-1] == pytest.approx(2.0)
    with pytest.raises(InputError, match="one"):
        figures.plot_error_over_time(errors, run.times[1:], tmp_path / "a.png")


def test_many_curves_stay_apart(run, tmp_path, monkeypatch):
    looks = []

    def save(figure, output):
        for line in figure.axes[0].get_lines():
            looks.append((line.get_color(), line.get_linestyle(), line.get_marker()))

    monkeypatch.setattr(curves, "_save", save)
    figures.plot_energy([run] * 16, tmp_path / "a.png", labels=list("abcdefghijklmnop"))
    assert len(set(looks)) == 16
    for first in range(9):  # of eight neighbours none shares colour and line, or the mark
        eight = looks[first : first + 8]
        assert len({look[:2] for look in eight}) == len({look[2] for look in eight}) == 8


def test_curves_refuse_bad_arguments(run, tmp_path):
    with pytest.raises(InputError, match="labels"):
        figures.plot_energy([run], tmp_path / "a.png", labels=["a", "b"])
    with pytest.raises(InputError, match="three coordinates"):
        figures.plot_node_trajectories(run, tmp_path / "a.png", node_point=[0.0], labels=["a"])
    with pytest.raises(InputError, match="ending in"):
        figures.plot_energy(run, tmp_path / "a.what", labels=["a"])
    with pytest.raises(OutputError, match=r"a\.png"):
        figures.plot_energy(run, tmp_path / "none" / "a.png", labels=["a"])


def test_plotting_leaves_the_users_backend_alone(run, tmp_path):
    import matplotlib as mpl

    before = mpl.rcParams._get_backend_or_none()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figures.plot_energy(run, tmp_path / "a.png", labels=["a"])
    assert mpl.rcParams._get_backend_or_none() == before


# --- is there a way to draw? -----------------------------------------------------------


def test_drawing_is_probed_in_another_process(monkeypatch):
    assert figures.check_offscreen().startswith("ok (")
    monkeypatch.setattr("pdcorrect.figures.panels._PROBE", "import os; os.abort()")
    assert "libegl1" in figures.check_offscreen()
    monkeypatch.setattr("pdcorrect.figures.panels._PROBE", "import time; time.sleep(30)")
    assert "no answer in 0.5 s" in figures.check_offscreen(timeout=0.5)


def test_an_x_window_that_cannot_be_opened_is_told_before_it_crashes(monkeypatch, tmp_path):
    monkeypatch.setenv("VTK_DEFAULT_OPENGL_WINDOW", "vtkXOpenGLRenderWindow")
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(OutputError, match="VTK_DEFAULT_OPENGL_WINDOW"):
        figures.render(trajectory(), tmp_path / "run.png")
    assert not list(tmp_path.iterdir())


def test_short_times_are_told_in_a_unit_that_shows_them():
    from pdcorrect.figures.sheet import time_text

    assert time_text(0.01, 1.0) == "0.010 s"
    assert time_text(1e-5, 1e-4) == "0.010 ms"
    assert time_text(0.0, 1e-4) == "0.000 ms"
    assert time_text(2e-6, 1e-5) == "2.000 µs"


def test_many_runs_are_drawn_in_rows_whose_text_fits_their_panels(run, tmp_path):
    names = [f"hybrid of a model, number {k}\nRMS error 0.123 mm" for k in range(7)]
    many = drawn(figures.render([run] * 7, tmp_path / "a.png", labels=names))
    four = drawn(figures.render([run] * 4, tmp_path / "b.png", labels=names[:4]))
    assert many.shape[1] == four.shape[1] == 1600
    blocks = np.diff(np.concatenate([[0], bodies(many).any(axis=1).astype(int), [0]]))
    starts, stops = np.flatnonzero(blocks == 1), np.flatnonzero(blocks == -1)
    tall = stops - starts > 60
    assert tall.sum() == 2  # rows of bodies
    first, second = (many[a:b] for a, b in zip(starts[tall], stops[tall], strict=True))
    assert bodies(first)[:, 1200:].any()
    assert not bodies(second)[:, 1200:].any()  # four above, three below
