"""Runs inside Blender's Python: draws models one after another in Cycles, by jobs of
mistyle/render/external/cycles_worker.py.

Takes a JSON file: `settings` (the folder of cycles_worker.py) and `jobs`, of which each names its model (`glb`, a glTF
or a USD file) and one shot. A model whose picture is there already is skipped, so that the same command goes on after
a crash. Beside each picture a `.json` lists what Blender made of the file, or a `.error` why it made nothing.
"""

import contextlib
import json
import os
import sys
import traceback

import bpy  # pyright: ignore[reportMissingImports]


def main(path):
    with open(path, encoding="utf-8") as file:
        order = json.load(file)
    sys.path.insert(0, order["settings"])
    import cycles_worker

    for job in order["jobs"]:
        out = job["shots"][0]["out"]
        if os.path.exists(out) or os.path.exists(out + ".error"):
            continue
        # Where Blender itself crashes, this file stays and the next run passes the model by.
        with open(out + ".error", "w", encoding="utf-8") as file:
            file.write("Blender crashed")
        try:
            draw(cycles_worker, job)
        except Exception:
            with open(out + ".error", "w", encoding="utf-8") as file:
                file.write(traceback.format_exc(limit=-3))
            continue
        os.remove(out + ".error")


def draw(worker, job):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    load(job["glb"])
    scene = bpy.context.scene
    single_scattering()
    for thing in list(scene.objects):
        if thing.type in ("LIGHT", "CAMERA"):
            bpy.data.objects.remove(thing)
    worker.camera(scene, job)
    worker.lights(scene, job)
    worker.settings(scene, job)
    scene.render.use_persistent_data = False
    # Light goes through as many surfaces as a stack of transparent ones has.
    scene.cycles.transparent_max_bounces = 32
    shot = job["shots"][0]
    scene.cycles.samples, scene.cycles.seed = shot["spp"], shot["seed"]
    scene.render.filepath = shot["out"]
    with quiet():
        bpy.ops.render.render(write_still=True)
    meshes = [o for o in scene.objects if o.type == "MESH"]
    made = {
        "blender": bpy.app.version_string,
        "meshes": len(meshes),
        "faces": sum(len(o.data.polygons) for o in meshes),
    }
    with open(shot["out"] + ".json", "w", encoding="utf-8") as file:
        json.dump(made, file)


def load(path):
    """Import at rest: a glTF without its animations (which nothing says to play), a USD at its first time."""
    with quiet():
        if path.lower().endswith((".glb", ".gltf")):
            from io_scene_gltf2.blender.imp.scene import BlenderScene

            BlenderScene.create_animations = staticmethod(lambda gltf: None)
            bpy.ops.import_scene.gltf(filepath=path)
        else:
            bpy.ops.wm.usd_import(
                filepath=path,
                apply_unit_conversion_scale=True,
                import_lights=False,
                import_cameras=False,
                set_frame_range=True,
                import_usd_preview=True,
            )
            bpy.context.scene.frame_set(bpy.context.scene.frame_start)


def single_scattering():
    """glTF's lobe (specification, appendix B) has one bounce between facets; Blender adds the further ones to rough
    metals unless it is told not to."""
    for material in bpy.data.materials:
        for node in material.node_tree.nodes if material.node_tree else []:
            if node.type == "BSDF_PRINCIPLED":
                node.distribution = "GGX"


@contextlib.contextmanager
def quiet():
    """Blender prints a line a second to the console of its own, past Python's stdout."""
    sys.stdout.flush()
    kept, nothing = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nothing)


if __name__ == "__main__":
    main(sys.argv[-1])
