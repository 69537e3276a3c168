"""Runs inside Blender's Python (a separate environment): imports a GLB and renders it in Cycles.

Takes one JSON file: glb, size (width, height), fov_x (degrees), camera (4x4, OpenGL axes, the GLB's world), distance,
depth, threads, suns (direction towards, irradiance), environment (EXR in Blender's layout), and shots (out, spp, seed).
Writes each shot as EXR and beside the job file a `.done` JSON with Blender's version and the seconds of each shot.
Does not import mistyle.
"""

import json
import math
import sys
import time

import bpy  # pyright: ignore[reportMissingImports]
from mathutils import Matrix, Vector  # pyright: ignore[reportMissingImports]

# glTF is Y-up, Blender Z-up; its importer rotates by +90 degrees about X.
BLENDER_FROM_GLTF = Matrix(((1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1)))


def main(path):
    with open(path, encoding="utf-8") as file:
        job = json.load(file)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=job["glb"])
    scene = bpy.context.scene
    for obj in list(scene.objects):
        if obj.type in ("LIGHT", "CAMERA"):
            bpy.data.objects.remove(obj)
    camera(scene, job)
    lights(scene, job)
    settings(scene, job)
    seconds = []
    for shot in job["shots"]:
        scene.cycles.samples, scene.cycles.seed = shot["spp"], shot["seed"]
        scene.render.filepath = shot["out"]
        start = time.perf_counter()
        bpy.ops.render.render(write_still=True)
        seconds.append(time.perf_counter() - start)
    with open(path + ".done", "w", encoding="utf-8") as file:
        json.dump({"blender": bpy.app.version_string, "seconds": seconds}, file)


def settings(scene, job):
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.use_denoising = scene.cycles.use_adaptive_sampling = False
    scene.cycles.pixel_filter_type = "BOX"
    # Biased noise reduction is off, so that two renderers converge to the same picture.
    scene.cycles.sample_clamp_direct = scene.cycles.sample_clamp_indirect = 0.0
    scene.cycles.blur_glossy = 0.0
    scene.cycles.caustics_reflective = scene.cycles.caustics_refractive = True
    bounces = job["depth"] - 2
    scene.cycles.max_bounces = scene.cycles.diffuse_bounces = scene.cycles.glossy_bounces = bounces
    scene.render.film_transparent = True
    scene.render.resolution_x, scene.render.resolution_y = job["size"]
    scene.render.resolution_percentage = 100
    scene.render.threads_mode, scene.render.threads = "FIXED", job["threads"]
    scene.render.use_persistent_data = True
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_mode = "RGBA"
    scene.render.image_settings.color_depth = "32"


def camera(scene, job):
    data = bpy.data.cameras.new("camera")
    data.sensor_fit = "HORIZONTAL"
    data.angle = math.radians(job["fov_x"])
    data.clip_start, data.clip_end = job["distance"] * 0.01, job["distance"] * 100
    obj = bpy.data.objects.new("camera", data)
    obj.matrix_world = BLENDER_FROM_GLTF @ Matrix(job["camera"])
    scene.collection.objects.link(obj)
    scene.camera = obj


def lights(scene, job):
    for sun in job["suns"]:
        data = bpy.data.lights.new("sun", "SUN")
        strength = max(sun["irradiance"])
        data.energy, data.angle = strength, 0.0
        data.color = [c / strength if strength else 0.0 for c in sun["irradiance"]]
        obj = bpy.data.objects.new("sun", data)
        towards = BLENDER_FROM_GLTF.to_3x3() @ Vector(sun["direction"])
        obj.rotation_euler = towards.to_track_quat("Z", "Y").to_euler()
        scene.collection.objects.link(obj)
    world = bpy.data.worlds.new("world")
    scene.world = world
    world.use_nodes = True
    nodes = world.node_tree.nodes
    background = next(n for n in nodes if n.type == "BACKGROUND")
    image = nodes.new("ShaderNodeTexEnvironment")
    image.image = bpy.data.images.load(job["environment"])
    image.image.colorspace_settings.name = "Linear Rec.709"
    world.node_tree.links.new(image.outputs["Color"], background.inputs["Color"])


if __name__ == "__main__":
    main(sys.argv[-1])
