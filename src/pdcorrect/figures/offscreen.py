"""`check_offscreen`: is there a way to draw without a screen?"""

from __future__ import annotations

import subprocess
import sys

_PROBE = """
import pyvista as pv
plotter = pv.Plotter(off_screen=True, window_size=(64, 64))
plotter.add_mesh(pv.Cube(), color="red")
image = plotter.screenshot(return_img=True)
assert image.reshape(-1, 3).std() > 0
window = plotter.render_window
lines = window.ReportCapabilities().splitlines() if window else []
found = [line.split(":", 1)[1].strip() for line in lines if "renderer string" in line]
print(pv.__version__, type(window).__name__, found[0] if found else "")
"""


def check_offscreen(timeout: float = 120.0) -> str:
    """Draw a cube in another process, which may crash: "ok (...)" or what to install."""
    remedy = (
        "install EGL with `apt-get install libegl1 libgl1` (Debian, Ubuntu) or use a VTK built "
        "with OSMesa"
    )
    try:
        probe = subprocess.run(
            [sys.executable, "-c", _PROBE], capture_output=True, text=True, timeout=timeout
        )
    except subprocess.TimeoutExpired:
        return f"no answer in {timeout:g} s; {remedy}"
    if probe.returncode == 0:
        return f"ok ({' '.join(probe.stdout.split())})"
    last = probe.stderr.strip().splitlines()[-1:] or [f"exit status {probe.returncode}"]
    return f"failed ({last[0]}); {remedy}"
