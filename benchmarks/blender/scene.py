"""Runs inside Blender's Python (bpy, an environment of its own): imports a GLB and renders it in Cycles.

Takes one JSON file: glb, out (EXR), size, fov_x (degrees), camera (4x4, OpenGL axes, glTF world), distance, samples,
sun (direction towards the light, irradiance), sky (radiance). Knows nothing of mistyle.
"""

import json
import math
import sys

import bpy
from mathutils import Matrix, Vector

# glTF is Y-up, Blender Z-up; its importer turns +90 degrees about X.
BLENDER_FROM_GLTF = Matrix(((1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1)))


def main(path: str) -> None:
    with open(path, encoding="utf-8") as file:
        job = json.load(file)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=job["glb"])
    scene = bpy.context.scene
    place_camera(scene, job)
    place_lights(scene, job)
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples = job["samples"]
    scene.cycles.use_denoising = False
    scene.cycles.pixel_filter_type = "BOX"
    scene.cycles.seed = 0
    scene.cycles.max_bounces = 4
    scene.render.film_transparent = True
    scene.render.resolution_x = scene.render.resolution_y = job["size"]
    scene.render.resolution_percentage = 100
    scene.render.threads_mode = "FIXED"
    scene.render.threads = job["threads"]
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_mode = "RGBA"
    scene.render.image_settings.color_depth = "32"
    scene.render.filepath = job["out"]
    bpy.ops.render.render(write_still=True)
    meshes = [o for o in scene.objects if o.type == "MESH"]
    report = {
        "blender": bpy.app.version_string,
        "objects": [o.name for o in meshes],
        "materials": sorted({s.material.name for o in meshes for s in o.material_slots if s.material}),
        "images": {i.name: [i.colorspace_settings.name, *i.size] for i in bpy.data.images if i.source == "FILE"},
        "faces": sum(len(o.data.polygons) for o in meshes),
    }
    with open(job["out"] + ".json", "w", encoding="utf-8") as file:
        json.dump(report, file)


def place_camera(scene, job: dict) -> None:
    data = bpy.data.cameras.new("camera")
    data.sensor_fit = "HORIZONTAL"
    data.angle = math.radians(job["fov_x"])
    data.clip_start, data.clip_end = job["distance"] * 0.01, job["distance"] * 100
    camera = bpy.data.objects.new("camera", data)
    camera.matrix_world = BLENDER_FROM_GLTF @ Matrix(job["camera"])
    scene.collection.objects.link(camera)
    scene.camera = camera


def place_lights(scene, job: dict) -> None:
    data = bpy.data.lights.new("sun", "SUN")
    data.energy, data.angle = job["sun"]["irradiance"], 0.0
    sun = bpy.data.objects.new("sun", data)
    towards = BLENDER_FROM_GLTF.to_3x3() @ Vector(job["sun"]["direction"])
    sun.rotation_euler = towards.to_track_quat("Z", "Y").to_euler()
    scene.collection.objects.link(sun)
    world = bpy.data.worlds.new("world")
    scene.world = world
    world.use_nodes = True
    background = next(n for n in world.node_tree.nodes if n.type == "BACKGROUND")
    background.inputs["Color"].default_value = (1, 1, 1, 1)
    background.inputs["Strength"].default_value = job["sky"]


main(sys.argv[-1])
