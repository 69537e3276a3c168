"""MaterialX 1.39 export: one OpenPBR surface per material, its images beside it. Written as XML, without the library.

Nodes and inputs are those of the specification (`ND_open_pbr_surface_surfaceshader`, `ND_normalmap_float`); colours
are declared as "srgb_texture" in 8-bit files and by their linear space in EXR, data as none.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from mistyle.core.names import distinct
from mistyle.io.images.ocio import ColourSpace, materialx_space
from mistyle.io.store.atomic import atomic_write


@dataclass(frozen=True)
class HeightFile:
    """A height map: the displacement along the normal is (value - middle) scale, in the mesh's units."""

    file: str
    middle: float
    scale: float


@dataclass(frozen=True)
class Transparency:
    """Opacity and emission of a material, for the formats that hold them.

    alpha     whether the albedo file has the coverage in its alpha
    opacity   factor of the coverage, 0..1
    cutoff    coverage threshold: opaque at or above it, else transparent; None: blended
    emission  radiance, linear Rec.709
    """

    alpha: bool = False
    opacity: float = 1.0
    cutoff: float | None = None
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class TexturedMaterial:
    """A material and its images: file names as the document names them. The albedo is sRGB, or linear in `space` (None:
    linear Rec.709). `name` is an identifier (core/names.py); `title` is the user's name for it, or ""."""

    name: str
    albedo: str
    normal: str
    roughness: str
    metallic: str
    srgb: bool = True
    space: ColourSpace | None = None
    title: str = ""
    height: HeightFile | None = None
    light: Transparency = Transparency()


def write_materialx(path: Path, looks: Sequence[TexturedMaterial]) -> None:
    """Write the document; texture coordinates have v up, as MaterialX has them. Normal maps are tangent space, +Y."""
    root = Element("materialx", version="1.39", colorspace="lin_rec709")
    names = [look.name for look in looks]
    # Names are unique in the document: a material's own name may be SR_….
    every = distinct([*names, *(f"{kind}_{n}" for kind in ("NG", "SR", "DS") for n in names)])
    graphs, surfaces, moves = (every[k * len(names) : (k + 1) * len(names)] for k in (1, 2, 3))
    for look, graph_name, surface_name, move_name in zip(looks, graphs, surfaces, moves, strict=True):
        graph = SubElement(root, "nodegraph", name=graph_name)
        colour = _image(graph, "albedo", "color3", look.albedo)
        colour.set("colorspace", "srgb_texture" if look.srgb else materialx_space(look.space))
        _image(graph, "roughness", "float", look.roughness)
        _image(graph, "metallic", "float", look.metallic)
        _image(graph, "normal", "vector3", look.normal)
        bump = SubElement(graph, "normalmap", name="normal_in_world", type="vector3")
        SubElement(bump, "input", name="in", type="vector3", nodename="image_normal")
        outputs = (
            ("albedo", "color3", "image_albedo"),
            ("roughness", "float", "image_roughness"),
            ("metallic", "float", "image_metallic"),
            ("normal", "vector3", "normal_in_world"),
        )
        for name, kind, node in outputs:
            SubElement(graph, "output", name=f"out_{name}", type=kind, nodename=node)
        surface = SubElement(root, "open_pbr_surface", name=surface_name, type="surfaceshader")
        inputs = (
            ("base_color", "color3", "albedo"),
            ("specular_roughness", "float", "roughness"),
            ("base_metalness", "float", "metallic"),
            ("geometry_normal", "vector3", "normal"),
        )
        for name, kind, source in inputs:
            SubElement(surface, "input", name=name, type=kind, nodegraph=graph_name, output=f"out_{source}")
        material = SubElement(root, "surfacematerial", name=look.name, type="material")
        if look.title not in ("", look.name):
            material.set("doc", look.title)
        SubElement(material, "input", name="surfaceshader", type="surfaceshader", nodename=surface_name)
        if look.height is not None:
            _displaced((root, graph, material), (graph_name, move_name), look.height)
    ElementTree.indent(root, "  ")
    text = ElementTree.tostring(root, encoding="unicode")
    atomic_write(path, f'<?xml version="1.0"?>\n{text}\n'.encode())


def _displaced(where: tuple[Element, Element, Element], names: tuple[str, str], height: HeightFile) -> None:
    """The displacement of a material: its height map about its middle, scaled to the mesh's units. `where` are the
    document, the material's graph and the material; `names` those of the graph and of the displacement."""
    (root, graph, material), (graph_name, name) = where, names
    _image(graph, "height", "float", height.file)
    middle = SubElement(graph, "subtract", name="height_about_middle", type="float")
    SubElement(middle, "input", name="in1", type="float", nodename="image_height")
    SubElement(middle, "input", name="in2", type="float", value=f"{height.middle:.9g}")
    SubElement(graph, "output", name="out_height", type="float", nodename="height_about_middle")
    shader = Element("displacement", name=name, type="displacementshader")
    root.insert(list(root).index(material), shader)
    SubElement(shader, "input", name="displacement", type="float", nodegraph=graph_name, output="out_height")
    SubElement(shader, "input", name="scale", type="float", value=f"{height.scale:.9g}")
    SubElement(material, "input", name="displacementshader", type="displacementshader", nodename=name)


def _image(graph: Element, name: str, kind: str, file: str) -> Element:
    node = SubElement(graph, "image", name=f"image_{name}", type=kind)
    return SubElement(node, "input", name="file", type="filename", value=file)
