"""Runs inside Blender's Python: takes pictures of a glTF file as somebody does who has only Blender.

Takes one JSON file: model, out (folder), kind, views, turn (shifts the cameras along their spiral, 0..1), size (pixels
a side), samples, seed, threads, hdri and strength (of the world), plus `plain`, names of what is simplified, and
`maps`, one value for each map instead of the file's textures, or null. Kinds:

    lamps  every view under two suns and a point light, one at a time, fixed to the camera; linear EXR
    sky    every view under the hdri; 8-bit PNG, sRGB, view transform "Standard"
    relit  as sky, linear EXR

Writes the pictures, and `transforms.json` and `lights.json` with Blender's own numbers: its cameras' matrices, its
world (Z up), its units. Everything that is not named here has Blender's factory settings. Emission is off: a fit has
none. `plain` may hold "box" (pixel filter), "ggx" (no light between facets), "bump" and "facets" (no correction
of shadows at relief and at low-poly facets), "clamp" (indirect light unclamped), "denoise" (denoised). Does not import
mistyle.
"""

import json
import math
import os
import sys

import bpy  # pyright: ignore[reportMissingImports]
from mathutils import Matrix, Vector  # pyright: ignore[reportMissingImports]

FOV, DISTANCE = 30.0, 4.0  # degrees; radii of the model
# Towards the light in camera axes (x right, y up, z towards the viewer). The last is the point light's, at AWAY radii.
TOWARDS = ((-0.58, 0.48, 0.66), (0.74, 0.14, 0.66), (-0.10, -0.78, 0.62))
AWAY, IRRADIANCE = 3.0, 2.5


def main(path):
    with open(path, encoding="utf-8") as file:
        job = json.load(file)
    os.makedirs(job["out"], exist_ok=True)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=job["model"])
    scene = bpy.context.scene
    for thing in list(scene.objects):
        if thing.type in ("LIGHT", "CAMERA"):
            bpy.data.objects.remove(thing)
    bpy.context.view_layer.update()
    centre, radius = sphere(scene)
    for thing in scene.objects if "facets" in job["plain"] else ():
        thing.shadow_terminator_geometry_offset = 0.0
    materials(job)
    settings(scene, job)
    camera = new(scene, "camera", bpy.data.cameras.new("camera"))
    camera.data.angle = math.radians(FOV)
    camera.data.clip_start, camera.data.clip_end = 0.01 * radius, 100 * radius
    scene.camera = camera
    frames, lights = shoot(scene, job, camera, centre, radius)
    tree = {"camera_angle_x": camera.data.angle_x, "frames": frames}
    for name, content in (("transforms.json", tree), ("lights.json", lights)):
        with open(os.path.join(job["out"], name), "w", encoding="utf-8") as file:
            json.dump(content, file, indent=1)
    with open(path + ".done", "w", encoding="utf-8") as file:
        json.dump({"blender": bpy.app.version_string, "pictures": len(frames)}, file)


def shoot(scene, job, camera, centre, radius):
    """Take all pictures; the frames of transforms.json and the content of lights.json."""
    frames, views = [], {}
    lamps = [lamp(scene, k, radius) for k in range(len(TOWARDS))] if job["kind"] == "lamps" else []
    ending = ".png" if job["kind"] == "sky" else ".exr"
    if not lamps:
        sky(scene, job)
    for k in range(job["views"]):
        camera.matrix_world = looking(eye(k, job, centre, radius), centre)
        bpy.context.view_layer.update()
        for j, light in enumerate(lamps or [None]):
            name = f"view{k:03d}" + (f"_lamp{j}" if lamps else "")
            for other in lamps:
                other.hide_render = other is not light
            if light is not None:
                views[name] = [place(light, j, camera, centre, radius)]
            scene.render.filepath = os.path.join(job["out"], name + ending)
            bpy.ops.render.render(write_still=True)
            frames.append({"file_path": name + ending, "transform_matrix": rows(camera.matrix_world)})
    # Blender's world shows the picture's middle towards +X: 90 degrees from where lights.json has it.
    world = {"type": "environment", "file": os.path.basename(job["hdri"]), "turn": 90, "scale": job["strength"]}
    return frames, {"views": views} if lamps else {"lights": [world]}


def sphere(scene):
    """Centre of the box, and the radius about it, of all meshes."""
    meshes = [thing for thing in scene.objects if thing.type == "MESH"]
    points = [thing.matrix_world @ v.co for thing in meshes for v in thing.data.vertices]
    low, high = (Vector([pick(p[i] for p in points) for i in range(3)]) for pick in (min, max))
    centre = (low + high) / 2
    return centre, max((p - centre).length for p in points)


def eye(k, job, centre, radius):
    """One place of a Fibonacci sphere."""
    polar, azimuth = math.acos(1 - 2 * (k + 0.5) / job["views"]), math.pi * (1 + 5**0.5) * (k + 0.5 + job["turn"])
    direction = (math.sin(polar) * math.cos(azimuth), math.sin(polar) * math.sin(azimuth), math.cos(polar))
    return centre + DISTANCE * radius * Vector(direction)


def looking(place, target):
    turn = (target - place).to_track_quat("-Z", "Y")
    return Matrix.Translation(place) @ turn.to_matrix().to_4x4()


def lamp(scene, k, radius):
    kind = "POINT" if k == len(TOWARDS) - 1 else "SUN"
    data = bpy.data.lights.new(f"lamp{k}", kind)
    if kind == "SUN":
        data.energy, data.angle = IRRADIANCE, 0.0
    else:
        # A point light of P watts has the radiant intensity P / 4 pi per steradian.
        data.energy, data.shadow_soft_size = IRRADIANCE * 4 * math.pi * (AWAY * radius) ** 2, 0.0
    return new(scene, f"lamp{k}", data)


def place(light, k, camera, centre, radius):
    """Move a lamp with the camera; what lights.json says of it, in Blender's world."""
    towards = (camera.matrix_world.to_3x3() @ Vector(TOWARDS[k])).normalized()
    light.matrix_world = looking(centre + AWAY * radius * towards, centre)
    bpy.context.view_layer.update()
    if light.data.type == "SUN":
        direction = light.matrix_world.to_3x3() @ Vector((0, 0, 1))
        return {"type": "directional", "direction": list(direction), "irradiance": [light.data.energy] * 3}
    intensity = light.data.energy / (4 * math.pi)
    return {"type": "point", "position": list(light.matrix_world.translation), "intensity": [intensity] * 3}


def sky(scene, job):
    scene.world = bpy.data.worlds.new("world")
    scene.world.use_nodes = True
    tree = scene.world.node_tree
    background = next(node for node in tree.nodes if node.type == "BACKGROUND")
    picture = tree.nodes.new("ShaderNodeTexEnvironment")
    picture.image = bpy.data.images.load(job["hdri"])
    tree.links.new(picture.outputs["Color"], background.inputs["Color"])
    background.inputs["Strength"].default_value = job["strength"]


def materials(job):
    for material in bpy.data.materials:
        material.cycles.use_bump_map_correction = "bump" not in job["plain"]
        for node in material.node_tree.nodes if material.node_tree else []:
            if node.type == "BSDF_PRINCIPLED":
                unlink(material.node_tree, node, "Emission Strength", 0.0)
                if "ggx" in job["plain"]:
                    node.distribution = "GGX"
                if job["maps"] is not None:
                    for name in ("Base Color", "Roughness", "Metallic"):
                        unlink(material.node_tree, node, name, job["maps"][name])
                    unlink(material.node_tree, node, "Normal", None)


def unlink(tree, node, name, value):
    for link in list(node.inputs[name].links):
        tree.links.remove(link)
    if value is not None:
        node.inputs[name].default_value = value


def settings(scene, job):
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples, scene.cycles.seed = job["samples"], job["seed"]
    scene.cycles.use_denoising = "denoise" in job["plain"]
    scene.cycles.use_adaptive_sampling = False
    if "box" in job["plain"]:
        scene.cycles.pixel_filter_type = "BOX"
    if "clamp" in job["plain"]:
        scene.cycles.sample_clamp_indirect = 0.0
    scene.render.film_transparent = True
    scene.render.resolution_x = scene.render.resolution_y = job["size"]
    scene.render.resolution_percentage = 100
    scene.render.threads_mode, scene.render.threads = "FIXED", job["threads"]
    scene.render.use_persistent_data = True
    scene.view_settings.view_transform = "Standard"
    form = scene.render.image_settings
    form.file_format = "PNG" if job["kind"] == "sky" else "OPEN_EXR"
    form.color_mode, form.color_depth = "RGBA", "8" if job["kind"] == "sky" else "32"


def new(scene, name, data):
    thing = bpy.data.objects.new(name, data)
    scene.collection.objects.link(thing)
    return thing


def rows(matrix):
    return [list(row) for row in matrix]


if __name__ == "__main__":
    main(sys.argv[-1])
