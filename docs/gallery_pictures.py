"""Draws images/gallery-*.png, the pictures of the page on scenes (extra view).

python docs/gallery_pictures.py
"""

from pathlib import Path

from PIL import Image

import pdcorrect as pc

ROOT = Path(__file__).parents[1]
IMAGES = ROOT / "docs" / "images"
SCENES = (
    "lifting_gripper", "crawler", "pressure_finger", "dropped_jelly", "twisted_bar", "bracket",
)  # fmt: skip
COLOURS = 256


def main(folder: Path = IMAGES) -> None:
    """Run each scene, draw its last frame, reduce the colours."""
    for name in SCENES:
        scene = pc.Scene.load(ROOT / "examples" / f"{name}.toml")
        run = pc.rollout(pc.ProjectiveDynamics(pc.discretise(scene)))
        path = folder / f"gallery-{name.replace('_', '-')}.png"
        pc.render([run], path, labels=[scene.name], window=560)
        with Image.open(path) as picture:
            small = picture.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
        small.save(path, optimize=True)


if __name__ == "__main__":
    main()
