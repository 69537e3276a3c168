"""Runs inside Blender's Python (a separate environment): opens files and counts their contents.

Takes one JSON file: files. Writes beside it a `.done` JSON with Blender's version and, for each file, its meshes,
triangles and materials, the names of missing images, and the importer's error, if any. Does not import mistyle.
"""

import json
import sys

import bpy  # pyright: ignore[reportMissingImports]


def main(path):
    with open(path, encoding="utf-8") as file:
        job = json.load(file)
    counts = []
    for name in job["files"]:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        try:
            opened(name)
            counts.append(counted())
        except Exception as error:
            counts.append({"error": str(error).strip()[-300:]})
    with open(path + ".done", "w", encoding="utf-8") as file:
        json.dump({"blender": bpy.app.version_string, "found": counts}, file)


def opened(name):
    kind = name.lower().rpartition(".")[2]
    if kind in ("glb", "gltf"):
        bpy.ops.import_scene.gltf(filepath=name)
    elif kind == "obj":
        bpy.ops.wm.obj_import(filepath=name)
    else:
        bpy.ops.wm.usd_import(filepath=name)


def counted():
    meshes = [obj.data for obj in bpy.context.scene.objects if obj.type == "MESH"]
    for mesh in meshes:
        mesh.calc_loop_triangles()
    images = [image for image in bpy.data.images if image.source in ("FILE", "TILED")]
    return {
        "meshes": len(meshes),
        "triangles": sum(len(mesh.loop_triangles) for mesh in meshes),
        "materials": len(bpy.data.materials),
        "images": len(images),
        "missing": [image.name for image in images if 0 in image.size],
    }


if __name__ == "__main__":
    main(sys.argv[-1])
