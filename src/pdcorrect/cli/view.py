"""The command ``pdcorrect view``.  It imports what it needs when it runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pdcorrect.cli.common import say
from pdcorrect.errors import InputError, require_extra

if TYPE_CHECKING:
    from pdcorrect.figures.stage import Stage


def view(
    run: Annotated[Path, typer.Argument(help="Trajectory file.", show_default=False)],
    port: Annotated[int, typer.Option(help="Of the page; 0 is any free one.", min=0)] = 0,
    browser: Annotated[bool, typer.Option(help="Open the page.")] = True,
) -> None:
    """Show one run in the browser: turn it, move through time, choose the colours.

    This machine draws; the page is for it alone.  Ctrl-C ends it.
    """
    from pdcorrect.figures.stage import Stage
    from pdcorrect.io.trajectory import load_trajectory
    from pdcorrect.io.trajectory_reader import problem_of

    for module in ("pyvista", "trame", "trame_vtk", "trame_vuetify"):
        require_extra(module, "view")
    loaded, colours = load_trajectory(run), ["displacement", "stress", "volume"]
    try:
        problem_of(loaded)
    except InputError as error:
        say(f"without stress and volume: {run}: {error}")
        colours = colours[:1]
    server = _server(run.name, Stage(loaded), colours)
    server.controller.on_server_ready.add(lambda **_: say(f"http://localhost:{server.port}/"))
    server.start(port=port, open_browser=browser, show_connection_info=False, timeout=0)


def _server(title: str, stage: Stage, colours: Sequence[str]) -> Any:
    """The page, and what it asks for when the slider or the field changes."""
    from trame.app import get_server
    from trame.ui.vuetify3 import SinglePageLayout
    from trame.widgets import client, vtk, vuetify3

    server = get_server(client_type="vue3")
    state = server.state
    state.update({"frame": 0, "colour": colours[0], "colours": list(colours), "time": "0"})
    with SinglePageLayout(server) as layout:
        client.Style("html { overflow: hidden }")
        layout.icon.hide()
        layout.footer.hide()
        layout.title.set_text(title)
        with layout.toolbar:
            vuetify3.VSpacer()
            last, flat = len(stage.run.times) - 1, {"hide_details": True, "density": "compact"}
            vuetify3.VSlider(v_model=("frame", 0), min=0, max=last, step=1, **flat)
            vuetify3.VLabel("t = {{ time }} s", classes="mx-4")
            vuetify3.VSelect(
                v_model=("colour", colours[0]), items=("colours",), style="max-width: 14em", **flat
            )
        with layout.content:
            window = vtk.VtkRemoteView(stage.plotter.render_window, ref="window")

    @state.change("colour")
    def _coloured(colour: Any, **_: Any) -> None:
        stage.colour_by(colour)
        _moved(state.frame)

    @state.change("frame")
    def _moved(frame: float, **_: Any) -> None:
        stage.move_to(int(frame))
        state.time = f"{stage.run.times[int(frame)]:.4g}"
        window.update()

    return server
