"""The command ``pdcorrect render``."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Optional

import typer

from pdcorrect._files import check_new
from pdcorrect.cli.common import Overwrite, say
from pdcorrect.errors import InputError

Colour = StrEnum("Colour", ["displacement", "stress", "error", "none", "volume"])


def render(
    runs: Annotated[list[Path], typer.Argument(help="Trajectory files.", show_default=False)],
    output: Annotated[Path, typer.Option("-o", "--output", help="Picture: .png, .gif or .mp4.")],
    label: Annotated[Optional[list[str]], typer.Option(help="Title of each run, in order.")] = None,
    colour: Annotated[
        Colour, typer.Option(help="What to colour by; stress is von Mises stress, volume det F.")
    ] = Colour.displacement,
    frame: Annotated[Optional[int], typer.Option(help="Frame of a .png; -1 is the last.")] = None,
    fps: Annotated[float, typer.Option(help="Frames a second of a film.", min=0.1)] = 25.0,
    overlay: Annotated[bool, typer.Option("--overlay", help="Over each other (.png).")] = False,
    camera: Annotated[
        Optional[str],
        typer.Option(help="x, y, z, iso, or AZIMUTH,ELEVATION in degrees.", show_default=False),
    ] = None,
    warp: Annotated[float, typer.Option(help="Displacements so many times as large.")] = 1.0,
    section: Annotated[
        Optional[str], typer.Option(help="Cut by a plane, x=0.02 (m), through the body at rest.")
    ] = None,
    size: Annotated[Optional[str], typer.Option(help="WIDTHxHEIGHT of the picture.")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Draw one run or several side by side; errors are against the last run given.

    A .png shows one frame, a .gif or .mp4 all frames that the runs share.
    """
    from pdcorrect import figures
    from pdcorrect.io.trajectory import load_trajectory

    if colour is Colour.error and len(runs) < 2:
        raise InputError("--colour error: expected two runs or more, the last is the reference.")
    still = output.suffix.lower() == ".png"
    if frame is not None and not still:
        raise InputError(f"--frame with {output.suffix}: a film shows all frames; leave it out.")
    check_new(output, overwrite=overwrite)
    number = -1 if frame is None else frame
    view = _parsed("--camera", camera, _camera, "two angles, as 30,20")
    field: Any = None if colour is Colour.none else colour.value
    loaded = [load_trajectory(path) for path in runs]
    names = label or [path.stem for path in runs]
    if overlay:
        _refuse_with_overlay(colour=colour, warp=warp, section=section, size=size)
        figures.render_overlay(loaded, output, labels=names, frame=number, camera=view)
    else:
        figures.render(
            loaded,
            output,
            labels=names,
            colour=field,
            reference=loaded[-1] if colour is Colour.error else None,
            frame=number if still else None,
            fps=fps,
            camera=view,
            warp=warp,
            section=_parsed("--section", section, _section, "an axis and a place, as x=0.02"),
            size=_parsed("--size", size, _size, "WIDTHxHEIGHT, as 1200x800"),
        )
    say(f"wrote {output}")


def _refuse_with_overlay(**options: Any) -> None:
    usual = {"colour": Colour.displacement, "warp": 1.0}
    for name, value in options.items():
        if value != usual.get(name):
            raise InputError(
                f"--{name} {value} with --overlay: runs have a colour each and are drawn as they "
                "are; leave it out."
            )


def _camera(text: str) -> Any:
    return tuple(map(float, text.split(",", 1))) if "," in text else text


def _section(text: str) -> tuple[str, float]:
    axis, _, place = text.partition("=")
    return axis.strip(), float(place)


def _size(text: str) -> tuple[int, int]:
    width, height = map(int, text.lower().split("x"))
    return width, height


def _parsed(option: str, text: str | None, parse: Callable[[str], Any], expected: str) -> Any:
    """What an option says; `InputError` if it does not."""
    try:
        return None if text is None else parse(text)
    except ValueError:
        raise InputError(f"{option} {text}: expected {expected}.") from None
