"""Reader of MaterialX documents that a stage references: their materials as preview surfaces, in a layer in memory.

The layer has the paths of USD's own plug-in (`/MaterialX/Materials/<name>`), which usd-core from PyPI lacks. It takes
the place of the document in the references. Read are base colour, roughness, metalness and normal map; see
mtlx_graph.py. Includes of other documents are not followed. Needs `MaterialX`.
"""

from importlib import import_module
from typing import Any

import numpy as np

from mistyle.core.errors import InputRefused
from mistyle.io.sandbox.asset_folders import MeshFolders
from mistyle.io.usd.layers import PackagedFile, bytes_of, locate
from mistyle.io.usd.mtlx_graph import (
    COORDINATES,
    Affine,
    NotRead,
    constant,
    floats,
    product,
    value_of,
)

MAX_DOCUMENT_BYTES = 16 << 20
UNREAD = "mistyle:unread"  # custom data of a material: notes on what was not read
INPUTS = {"albedo": "diffuseColor", "roughness": "roughness", "metallic": "metallic", "normal": "normal"}
# By surface: the input of every map and its default; a colour's weight is named first.
SURFACES: dict[str, dict[str, tuple[tuple[str, ...], float]]] = {
    "standard_surface": {
        "albedo": (("base", "base_color"), 0.8),
        "roughness": (("specular_roughness",), 0.2),
        "metallic": (("metalness",), 0.0),
        "normal": (("normal",), 0.0),
    },
    "open_pbr_surface": {
        "albedo": (("base_weight", "base_color"), 0.8),
        "roughness": (("specular_roughness",), 0.3),
        "metallic": (("base_metalness",), 0.0),
        "normal": (("geometry_normal",), 0.0),
    },
    "gltf_pbr": {
        "albedo": (("base_color",), 1.0),
        "roughness": (("roughness",), 1.0),
        "metallic": (("metallic",), 1.0),
        "normal": (("normal",), 0.0),
    },
    "UsdPreviewSurface": {
        "albedo": (("diffuseColor",), 0.18),
        "roughness": (("roughness",), 0.5),
        "metallic": (("metallic",), 0.0),
        "normal": (("normal",), 0.0),
    },
}
# Inputs that change the appearance and are not read, unless they have this value.
NEUTRAL = dict.fromkeys(("opacity", "geometry_opacity", "alpha"), 1.0) | dict.fromkeys(
    ("transmission", "transmission_weight", "subsurface", "subsurface_weight", "sheen", "fuzz_weight", "sheen_color")
    + ("coat", "coat_weight", "clearcoat", "emission", "emission_luminance", "emissive", "emissiveColor")
    + ("thin_film_thickness", "thin_film_weight", "iridescence", "useSpecularWorkflow"),
    0.0,
)
WRAPS = {"": "repeat", "periodic": "repeat", "clamp": "clamp", "mirror": "mirror", "constant": "black"}


def preview_layer(pxr: Any, document: PackagedFile, folders: MeshFolders, notes: list[str]) -> tuple[Any, list[str]]:
    """The layer with a document's materials, and the textures that it names; (None, []) with a note where it is not
    readable."""
    root = _parsed(document, notes)
    if root is None:
        return None, []
    layer = pxr.Sdf.Layer.CreateAnonymous(".usda")
    stage = pxr.Usd.Stage.Open(layer)
    for scope in ("", "/Materials", "/NodeGraphs"):
        pxr.UsdGeom.Scope.Define(stage, f"/MaterialX{scope}")
    layer.defaultPrim = "MaterialX"
    textures: list[str] = []
    for node in root.getMaterialNodes():
        path = f"/MaterialX/Materials/{pxr.Tf.MakeValidIdentifier(node.getName())}"
        author = _Author(pxr, pxr.UsdShade.Material.Define(stage, path), document, folders)
        source = node.getInput("surfaceshader")
        surface = source.getConnectedNode() if source is not None else None
        if surface is not None and surface.getCategory() in SURFACES:
            author.surface(surface)
        textures += author.textures
    return layer, textures


def _parsed(document: PackagedFile, notes: list[str]) -> Any:
    """The document's tree; None, with a note, where it cannot be read."""
    what = f"MaterialX document {document}"
    try:
        mx: Any = import_module("MaterialX")
        data = bytes_of(document, MAX_DOCUMENT_BYTES)
    except ImportError:
        notes.append(
            f"{what} was left out with its materials: reading it needs MaterialX (pip install 'mistyle[usd]')."
        )
        return None
    except InputRefused as error:
        notes.append(f"{what} was left out with its materials: {error}")
        return None
    if data is None:
        notes.append(f"{what} is not there; its materials were left out.")
        return None
    root, options, text = mx.createDocument(), mx.XmlReadOptions(), data.decode("utf-8", "replace")
    options.readXIncludeFunction = None  # no other file is opened
    try:
        mx.readFromXmlString(root, text, mx.FileSearchPath(), options)
    except Exception as error:  # of several kinds, for XML and for what it says
        notes.append(f"{what} was left out with its materials: {str(error).splitlines()[0][:160]}")
        return None
    if "include" in text and "XInclude" in text:
        notes.append(f"{what} includes other documents, which were not read.")
    return root


class _Author:
    """Writes one material's preview surface; collects its `textures` (state over the inputs)."""

    def __init__(self, pxr: Any, material: Any, document: PackagedFile, folders: MeshFolders) -> None:
        self.pxr, self.material, self.document, self.folders = pxr, material, document, folders
        self.textures: list[str] = []
        self.notes: list[str] = []

    def surface(self, node: Any) -> None:
        """Define the preview surface of a MaterialX surface node."""
        pxr, kinds = self.pxr, self.pxr.Sdf.ValueTypeNames
        shader = self._shader("surface", "UsdPreviewSurface")
        self.material.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", kinds.Token))
        types = {"albedo": kinds.Color3f, "normal": kinds.Normal3f}
        for kind, (names, default) in SURFACES[node.getCategory()].items():
            target = shader.CreateInput(INPUTS[kind], types.get(kind, kinds.Float))
            try:
                value = self._value(node, kind, names, default)
                if value.leaf is not None:
                    target.ConnectToSource(self._texture(kind, value))
                elif kind == "albedo":
                    target.Set(pxr.Gf.Vec3f(*map(float, value.bias)))
                elif kind != "normal":
                    target.Set(float(value.bias[0]))
            except NotRead as error:
                self._note(f"The {names[-1]} of MaterialX material '{self._name}' has {error}, which was not read.")
        unread = [i.getName() for i in node.getInputs() if i.getName() in NEUTRAL and _differs(i)]
        if unread:
            self._note(f"The {' and '.join(unread)} of MaterialX material '{self._name}' was not read.")
        self.material.GetPrim().SetCustomDataByKey(UNREAD, pxr.Vt.StringArray(self.notes))

    @property
    def _name(self) -> str:
        return self.material.GetPrim().GetName()

    def _note(self, text: str) -> None:
        self.notes.append(text)

    def _shader(self, name: str, kind: str) -> Any:
        path = self.material.GetPath().AppendChild(name)
        shader = self.pxr.UsdShade.Shader.Define(self.material.GetPrim().GetStage(), path)
        shader.CreateIdAttr(kind)
        return shader

    def _value(self, node: Any, kind: str, names: tuple[str, ...], default: float) -> Affine:
        value = value_of(node.getInput(names[-1]), []) or constant(default)
        for weight in names[:-1]:
            value = product(value_of(node.getInput(weight), []) or constant(1.0), value)
        if value.leaf is None:
            return value
        if value.leaf.getCategory() in COORDINATES:
            raise NotRead(f"a node '{value.leaf.getCategory()}'")
        if value.channel != "rgb" and (np.ptp(value.scale) or np.ptp(value.bias)):
            raise NotRead("one channel of a texture times a colour")
        if kind == "normal" and not value.normals and value.leaf.getCategory() != "UsdUVTexture":
            raise NotRead("a texture without a normal map node")
        if kind in ("roughness", "metallic") and value.channel == "rgb":
            raise NotRead("a colour")
        return value

    def _texture(self, kind: str, value: Affine) -> Any:
        """The output of a texture: its file, colour space, coordinates, scale and bias."""
        pxr, kinds, node = self.pxr, self.pxr.Sdf.ValueTypeNames, value.leaf
        file = node.getInput("file")
        file = (file.getInterfaceInput() or file) if file is not None and file.getInterfaceName() else file
        name = file.getResolvedValueString() if file is not None else ""
        try:
            place = locate(self.folders, self.document, name)
        except InputRefused as error:
            self._note(f"Texture {name} was left out: {error}")
            raise NotRead("a texture that was left out") from None
        self.textures.append(str(place))
        shader = self._shader(kind, "UsdUVTexture")
        shader.CreateInput("file", kinds.Asset).Set(pxr.Sdf.AssetPath(str(place)))
        shader.CreateInput("sourceColorSpace", kinds.Token).Set(self._space(kind, node, file))
        for axis, letter in (("u", "S"), ("v", "T")):
            mode = node.getInput(f"{axis}addressmode") or node.getInput(f"wrap{letter}")
            wrap = WRAPS.get(mode.getValueString() if mode is not None else "", "repeat")
            shader.CreateInput(f"wrap{letter}", kinds.Token).Set(wrap)
        for label, numbers, rest in (("scale", value.scale, 1.0), ("bias", value.bias, 0.0)):
            shader.CreateInput(label, kinds.Float4).Set(pxr.Gf.Vec4f(*map(float, numbers), rest))
        shader.CreateInput("st", kinds.Float2).ConnectToSource(self._coordinates(kind, node))
        width = kinds.Float3 if value.channel == "rgb" else kinds.Float
        return shader.CreateOutput(value.channel, width)

    def _space(self, kind: str, node: Any, file: Any) -> str:
        """The texture's encoding: data has none, and a colour without a colour space follows its file."""
        if kind != "albedo" or not node.getType().startswith(("color", "multioutput")):
            return "raw"
        space = file.getActiveColorSpace() if file is not None else ""
        if space and space not in ("srgb_texture", "lin_rec709", "raw", "none"):
            self._note(f"The colour space {space} of MaterialX material '{self._name}' was read as linear Rec.709.")
        return {"": "auto", "srgb_texture": "sRGB"}.get(space, "raw")

    def _coordinates(self, kind: str, node: Any) -> Any:
        """The output of the texture's coordinates: a primvar, scaled and moved."""
        pxr, kinds = self.pxr, self.pxr.Sdf.ValueTypeNames
        own = value_of(node.getInput("texcoord") or node.getInput("st"), []) or constant(0.0)
        primvar = ""
        if own.leaf is None:
            own = Affine(None, np.ones(3), np.zeros(3))
        elif COORDINATES.get(own.leaf.getCategory()):
            name = own.leaf.getInput(COORDINATES[own.leaf.getCategory()])
            primvar = name.getValueString() if name is not None else ""
        scale, move = own.scale, own.bias
        if node.getCategory() == "tiledimage":
            tiling, offset = (value_of(node.getInput(n), []) for n in ("uvtiling", "uvoffset"))
            scale, move = (v * (1.0 if tiling is None else tiling.bias) for v in (scale, move))
            move = move if offset is None else move - offset.bias
        unread = ("rotate", "offset", "scale") if node.getCategory().startswith("gltf") else ()
        unread += ("realworldimagesize", "realworldtilesize")
        if any(node.getInput(n) is not None for n in unread):
            self._note(f"The placement of a texture of MaterialX material '{self._name}' was not read.")
        reader = self._shader(f"{kind}_st", "UsdPrimvarReader_float2")
        reader.CreateInput("varname", kinds.String).Set(primvar or "st")
        output = reader.CreateOutput("result", kinds.Float2)
        if (scale == 1).all() and not move.any():
            return output
        moved = self._shader(f"{kind}_transform", "UsdTransform2d")
        moved.CreateInput("in", kinds.Float2).ConnectToSource(output)
        moved.CreateInput("scale", kinds.Float2).Set(pxr.Gf.Vec2f(*map(float, scale[:2])))
        moved.CreateInput("translation", kinds.Float2).Set(pxr.Gf.Vec2f(*map(float, move[:2])))
        return moved.CreateOutput("result", kinds.Float2)


def _differs(port: Any) -> bool:
    """Whether an input has another value than its neutral one."""
    if port.getNodeName() or port.getNodeGraphString() or port.getInterfaceName():
        return True
    text, neutral = port.getValueString(), NEUTRAL[port.getName()]
    return text == "true" or any(number != neutral for number in floats(text))
