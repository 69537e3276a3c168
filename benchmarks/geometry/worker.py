"""Runs inside Blender's Python (bpy, an environment of its own): imports a GLB and writes its corners.

`python worker.py ASSET.glb OUT.npz`: `corners` (t 3 3) are world positions in glTF's axes (Y up), `uvs`
(t 3 2) with v up, by triangle.
"""

import sys

import bpy  # pyright: ignore[reportMissingImports]
import numpy as np


def main(glb: str, out: str) -> None:
    """Import the file and write every triangle of its meshes."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=glb)
    corners, uvs = [], []
    for item in bpy.data.objects:
        if item.type != "MESH":
            continue
        mesh = item.data
        mesh.calc_loop_triangles()
        matrix = np.array(item.matrix_world)
        places = np.array([v.co for v in mesh.vertices]) @ matrix[:3, :3].T + matrix[:3, 3]
        st = np.array([entry.vector for entry in mesh.uv_layers.active.uv])
        for triangle in mesh.loop_triangles:
            corners.append(places[list(triangle.vertices)])
            uvs.append(st[list(triangle.loops)])
    x, y, z = np.moveaxis(np.array(corners), -1, 0)
    np.savez(out, corners=np.stack([x, z, -y], axis=-1), uvs=np.array(uvs))


if __name__ == "__main__":
    main(*sys.argv[1:])
