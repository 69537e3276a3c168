"""Runs inside Blender's Python: worker.py, with corrections where Blender's importer departs from the file.

Each job names its correction (`mend`), from `benchmarks/gallery/reasons.json`:

    colour spaces    an image that serves as colour and as data: sRGB for base colour and emission, raw for the rest
    display color    `displayColor` becomes the base colour of a matt material (UsdGeomGprim)
    webp             the WebP pictures of EXT_texture_webp replace their fallbacks
    units            the stage's metersPerUnit is ignored, as USD refuses the file's type of it
    sphere           a UsdGeomSphere is subdivided onto the sphere
"""

import json
import os
import sys

import bpy  # pyright: ignore[reportMissingImports]
import worker  # pyright: ignore[reportMissingImports]

COLOURS = ("Base Color", "Emission Color", "Specular Tint")


def main(path):
    with open(path, encoding="utf-8") as file:
        mends = {job["glb"]: job["mend"] for job in json.load(file)["jobs"]}
    plain = worker.load

    def load(model):
        if mends[model] == "units":
            with worker.quiet():
                bpy.ops.wm.usd_import(
                    filepath=model,
                    apply_unit_conversion_scale=False,
                    import_lights=False,
                    import_cameras=False,
                    import_usd_preview=True,
                )
            return
        plain(model)
        MENDS[mends[model]](model)

    worker.load = load
    worker.main(path)


def colour_spaces(model):
    for material in bpy.data.materials:
        tree = material.node_tree
        for node in [n for n in tree.nodes if n.type == "TEX_IMAGE" and n.image] if tree else []:
            links = [link for output in node.outputs for link in output.links]
            colour = [link for link in links if link.to_socket.name in COLOURS or mixes_colour(link)]
            node.image.colorspace_settings.name = "Non-Color"
            if not colour:
                continue
            twin = tree.nodes.new("ShaderNodeTexImage")
            twin.image = node.image.copy()
            twin.image.colorspace_settings.name = "sRGB"
            twin.interpolation, twin.extension = node.interpolation, node.extension
            for link in node.inputs["Vector"].links:
                tree.links.new(link.from_socket, twin.inputs["Vector"])
            for link in colour:
                tree.links.new(twin.outputs[link.from_socket.name], link.to_socket)


def mixes_colour(link):
    """Whether a link ends in a node that mixes the base colour with its factor."""
    node = link.to_node
    after = [far for output in node.outputs for far in output.links]
    return node.type in ("MIX", "MIX_RGB") and any(far.to_socket.name in COLOURS for far in after)


def display_color(model):
    for thing in bpy.context.scene.objects:
        if thing.type != "MESH" or any(thing.data.materials) or "displayColor" not in thing.data.attributes:
            continue
        material = bpy.data.materials.new("display")
        tree = material.node_tree
        attribute = tree.nodes.new("ShaderNodeAttribute")
        attribute.attribute_name = "displayColor"
        surface = next(n for n in tree.nodes if n.type == "BSDF_PRINCIPLED")
        tree.links.new(attribute.outputs["Color"], surface.inputs["Base Color"])
        thing.data.materials.append(material)


def webp(model):
    with open(model, encoding="utf-8") as file:
        tree = json.load(file)
    images = tree["images"]
    for texture in tree["textures"]:
        better = texture.get("extensions", {}).get("EXT_texture_webp")
        if better is None or "source" not in texture:
            continue
        first, second = (images[k]["uri"] for k in (texture["source"], better["source"]))
        replacement = bpy.data.images.load(os.path.join(os.path.dirname(model), second))
        for material in bpy.data.materials:
            for node in material.node_tree.nodes if material.node_tree else []:
                if node.type == "TEX_IMAGE" and os.path.basename(node.image.filepath) == os.path.basename(first):
                    replacement.colorspace_settings.name = node.image.colorspace_settings.name
                    node.image = replacement


def sphere(model):
    for thing in [o for o in bpy.context.scene.objects if o.type == "MESH"]:
        radius = max(vertex.co.length for vertex in thing.data.vertices)
        finer = thing.modifiers.new("finer", "SUBSURF")
        finer.subdivision_type, finer.levels, finer.render_levels = "SIMPLE", 4, 4
        round_one = thing.modifiers.new("round", "CAST")
        round_one.factor, round_one.use_radius_as_size, round_one.radius = 1.0, False, 0.0
        round_one.size = radius
        for polygon in thing.data.polygons:
            polygon.use_smooth = True


MENDS = {
    "colour spaces": colour_spaces,
    "display color": display_color,
    "webp": webp,
    "sphere": sphere,
}

if __name__ == "__main__":
    main(sys.argv[-1])
