"""EbSynth as a row of `benchmarks.consistency`, by its own command line program.

EbSynth (Jamriska 2018, public domain) is fetched and built by whoever wants the row, outside this repository:
`git clone https://github.com/jamriska/ebsynth; cd ebsynth; sh build-linux-cpu_only.sh`, then `--ebsynth bin/ebsynth`.
"""

import resource
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from benchmarks.consistency.rows import Row
from benchmarks.consistency.scene import Scene
from mistyle.core.image import nearest_fill
from mistyle.io.read import read_picture
from mistyle.stylization.surface.exemplar import exemplar as styles


def ebsynth(program: Path) -> Callable[[Scene], Row]:
    """EbSynth with its default settings, view by view, with the colour and the detail guide of our own stylizer.

    The guides are in the same units and weigh as much as ours: 1 for colour, `surface.detail` for detail, against 1
    for the patches. The painting has the size at which our views show it. Making the guides is not counted.
    """

    def work(scene: Scene) -> Row:
        pictures, seconds = [], 0.0
        with tempfile.TemporaryDirectory() as scratch:
            folder = Path(scratch)
            save(folder / "style.png", scene.painting)
            broad, band = source_guides(scene.painting)
            save(folder / "source_colour.png", broad)
            save(folder / "source_detail.png", grey(band))
            weight = f"{scene.settings.surface.detail:g}"
            for view, colour, detail in zip(scene.views, scene.colour, scene.detail, strict=True):
                # It knows no mask: guides that end in black would draw dark strokes over the silhouette.
                wanted = scene.settings.surface.relief * float(band.std()) * detail
                save(folder / "colour.png", nearest_fill(colour, view.mask))
                save(folder / "detail.png", grey(nearest_fill(wanted, view.mask)))
                command = [program.resolve(), "-style", "style.png", "-output", "out.png", "-backend", "cpu"]
                command += ["-guide", "source_colour.png", "colour.png", "-weight", "1"]
                command += ["-guide", "source_detail.png", "detail.png", "-weight", weight]
                start = time.perf_counter()
                subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL)
                seconds += time.perf_counter() - start
                drawn = read_picture(folder / "out.png").rgb
                pictures.append(np.where(view.mask[..., None], drawn, 0).astype(np.float32))
        outside = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024 / 1e9
        return Row(pictures, seconds, held_gb=outside)

    return work


def source_guides(painting: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Large-area colours (encoded) and the lightness band (Lab / 100) of the painting, as `surface.style.exemplar`."""
    lab = styles.lab_from_srgb(painting)
    sigma = max(0.6, max(painting.shape[:2]) * styles.BROAD)
    broad = styles.blurred(lab, sigma)
    band = styles.blurred(lab[..., 0], max(0.6, 0.22 * sigma)) - broad[..., 0]
    return cv2.cvtColor(100 * broad, cv2.COLOR_Lab2RGB), band


def grey(band: np.ndarray) -> np.ndarray:
    """A band around zero as a grey picture, one to one."""
    return np.repeat(np.clip(0.5 + band, 0, 1)[..., None], 3, axis=-1)


def save(path: Path, picture: np.ndarray) -> None:
    """An 8-bit PNG of an encoded picture."""
    eight = np.round(np.clip(picture, 0, 1) * 255).astype(np.uint8)
    cv2.imwrite(str(path), cv2.cvtColor(eight, cv2.COLOR_RGB2BGR))
