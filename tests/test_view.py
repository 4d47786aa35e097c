"""The viewer: what it shows, that its page answers, and that a browser draws it."""

import asyncio
import re
import shutil
import subprocess
import sys
import urllib.request
from itertools import pairwise

import numpy as np
import pytest

import pdcorrect as pc
from conftest import beam
from pdcorrect.cli.common import BAD_INPUT

pytest.importorskip("pyvista")

OBSTACLES = [
    {"shape": "box", "box": [[0.1, 0.0, -0.1], [0.2, 0.1, -0.05]],
     "motion": {"times": [0.0, 0.02], "displacement": [[0.0, 0.0, 0.0], [0.0, 0.0, 0.02]]}}
]  # fmt: skip


@pytest.fixture(scope="module")
def run_file(tmp_path_factory):
    scene = beam((2, 2, 2), 0.05, obstacles=OBSTACLES)
    path = tmp_path_factory.mktemp("view") / "run.h5"
    pc.save_trajectory(path, pc.rollout(pc.ProjectiveDynamics(pc.discretise(scene)), frames=2))
    return path


def test_the_stage_moves_body_and_obstacles_and_changes_colours(run_file):
    from pdcorrect.figures.stage import Stage

    run = pc.load_trajectory(run_file)
    stage, pictures = Stage(run), []
    try:
        for frame, colour in ((0, "displacement"), (2, "displacement"), (2, "stress")):
            stage.colour_by(colour)
            stage.move_to(frame)
            assert len(stage.plotter.scalar_bars) == 1
            stage.plotter.render()
            pictures.append(stage.plotter.screenshot(None, return_img=True).astype(int))
        body, (_, box) = stage.plotter.actors["body"], stage._obstacles[0]
        np.testing.assert_array_equal(body.mapper.dataset.points, run.positions[2])
        np.testing.assert_allclose(np.array(box.user_matrix)[:3, 3], [0.0, 0.0, 0.02])
    finally:
        stage.plotter.close()
    assert all((a != b).any() for a, b in pairwise(pictures))


def test_a_file_that_is_no_run_is_refused(program, tmp_path):
    pytest.importorskip("trame")
    status, _, err = program("view", tmp_path / "none.h5", "--no-browser")
    assert status == BAD_INPUT
    assert "none.h5" in err


@pytest.fixture(scope="module")
def address(run_file):
    """Of a viewer that runs."""
    pytest.importorskip("trame")
    command = [sys.executable, "-m", "pdcorrect", "view", run_file, "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process.stdout.readline().strip()
        finally:
            process.terminate()


def test_its_page_answers(address):
    with urllib.request.urlopen(address, timeout=10) as answer:
        assert answer.status == 200
        assert b"<html" in answer.read()


DRAWN = """
(async () => {
    const image = document.querySelector(".v-main img");
    if (!image || !image.naturalWidth) return 0;
    const canvas = document.createElement("canvas");
    canvas.width = image.naturalWidth; canvas.height = image.naturalHeight;
    const context = canvas.getContext("2d");
    context.drawImage(image, 0, 0);
    return new Set(new Uint32Array(
        context.getImageData(0, 0, canvas.width, canvas.height).data.buffer)).size;
})()
"""
"""How many colours the page's picture has."""


async def colours_in_a_browser(address, profile):
    """What `DRAWN` says in headless Chromium, and the errors that it logs."""
    aiohttp = pytest.importorskip("aiohttp")
    browser = await asyncio.create_subprocess_exec(
        shutil.which("chromium"), "--headless", "--no-sandbox", "--disable-gpu",
        "--remote-debugging-port=0", f"--user-data-dir={profile}", "about:blank",
        stderr=asyncio.subprocess.PIPE,
    )  # fmt: skip
    errors, number = [], 0
    try:
        while not (
            host := re.search(rb"listening on ws://([^/]+)/", await browser.stderr.readline())
        ):
            pass
        async with aiohttp.ClientSession() as session:
            tabs = await (await session.get(f"http://{host[1].decode()}/json")).json()
            page = next(tab for tab in tabs if tab["type"] == "page")
            tab = await session.ws_connect(page["webSocketDebuggerUrl"], max_msg_size=0)

            async def call(method, **arguments):
                nonlocal number
                number += 1
                await tab.send_json({"id": number, "method": method, "params": arguments})
                while (said := await tab.receive_json()).get("id") != number:
                    entry = said.get("params", {}).get("entry", {})
                    thrown = said.get("method") == "Runtime.exceptionThrown"
                    if thrown or entry.get("level") == "error":
                        errors.append(entry.get("url", said))
                return said["result"]

            for domain in ("Runtime", "Log", "Page"):
                await call(f"{domain}.enable")
            await call("Page.navigate", url=address)
            colours = 0
            for _ in range(60):
                await asyncio.sleep(0.5)
                found = await call(
                    "Runtime.evaluate", expression=DRAWN, awaitPromise=True, returnByValue=True
                )
                colours = found["result"].get("value", 0)
                if colours > 20:
                    break
            return colours, errors
    finally:
        browser.kill()
        await browser.wait()


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("chromium"), reason="needs chromium")
def test_a_browser_shows_the_body(address, tmp_path):
    colours, errors = asyncio.run(colours_in_a_browser(address, tmp_path))
    assert colours > 20
    # trame's page first asks for a launcher, which there is none
    assert [error for error in errors if not str(error).endswith("/paraview/")] == []
