"""Predicted pictures of a fit."""

from pathlib import Path
from typing import Any

import numpy as np

from mistyle.core.camera import look_at
from mistyle.core.capture import in_memory
from mistyle.core.light import Directional
from mistyle.core.maps import flat_maps
from mistyle.fitting.pipeline.material import measure
from mistyle.fitting.settings.material import MaterialSettings
from mistyle.io.read_mesh import read_mesh
from mistyle.render.mitsuba import device
from mistyle.render.mitsuba import scene as scenery
from mistyle.render.mitsuba.emitters import emitters
from mistyle.solver.recover import Recovered

SIZE, SIDE = 32, 64
GROOVE = """v -1 1 -1
v 0 0 -1
v 1 1 -1
v -1 1 1
v 0 0 1
v 1 1 1
vt 0.02 0.02
vt 0.48 0.02
vt 0.02 0.98
vt 0.48 0.98
vt 0.52 0.02
vt 0.98 0.02
vt 0.52 0.98
vt 0.98 0.98
f 1/1 4/3 5/4 2/2
f 2/5 5/7 6/8 3/6
"""


def test_predictions_have_the_indirect_light_that_the_maps_lack(tmp_path: Path) -> None:
    """A pale groove under a lamp, path traced: much of its light has met both walls."""
    device.use()
    import mitsuba

    mi: Any = mitsuba
    (tmp_path / "groove.obj").write_text(GROOVE)
    asset, maps = read_mesh(tmp_path / "groove.obj", size=SIZE), flat_maps(SIZE, albedo=0.8, roughness=1.0)
    camera = look_at([0.5, 4.0, 0.5], fov=30, size=(SIDE, SIDE), name="above")
    lights = (Directional((0.0, 1.0, 0.0), (2.0, 2.0, 2.0), "world"),)
    scene = {"type": "scene", "integrator": {"type": "path", "max_depth": 6}}
    scene |= {"sensor": scenery.sensor_dict(camera, 256)}
    scene |= scenery.object_shapes(asset.mesh, [maps], frame="mikkt")
    scene |= {f"light{k}": light for k, light in enumerate(emitters(lights, camera))}
    reference = np.array(mi.render(mi.load_dict(scene, optimize=False), spp=256, seed=1))[..., :3].astype(np.float32)
    captures = in_memory([camera], [lights], [reference])

    def predicted(indirect: bool) -> float:
        grids = np.zeros((SIZE, SIZE), np.float32), np.zeros((SIZE, SIZE), int)
        spread = dict.fromkeys(("albedo", "normal", "roughness", "metallic"), grids[0])
        found = Recovered((maps,), (grids[0],), (spread,), (grids[1],), (grids[1],), {}, {}, (), indirect=indirect)
        return measure(asset, found, captures, MaterialSettings(), lambda done: None).psnr[0]

    assert predicted(True) > 35 > 25 > predicted(False)
