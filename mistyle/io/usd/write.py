"""USD writer: a mesh with UsdPreviewSurface materials, as text (.usda) and as one package (.usdz). Needs `usd-core`."""

import struct
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.core.errors import EnvironmentMissing, MistyleError
from mistyle.core.mesh import Mesh, local_origin
from mistyle.io.materialx import TexturedMaterial, Transparency

NAMES = ("Ar", "Gf", "Kind", "Sdf", "Tf", "Usd", "UsdGeom", "UsdLux", "UsdShade", "UsdSkel", "UsdUtils")
NAMES += ("UsdValidation", "Vt")
UTF8 = 1 << 11  # zip's flag for a name in UTF-8; without it readers assume code page 437
FIRST_DAY = struct.pack("<HH", 0, 1 << 5 | 1)  # DOS time and date of 1980-01-01


def library() -> Any:
    """The modules of pxr, by name. Raises EnvironmentMissing where they are not installed."""
    try:
        return SimpleNamespace(**{name: import_module(f"pxr.{name}") for name in NAMES})
    except ImportError:
        raise EnvironmentMissing("USD needs usd-core: pip install 'mistyle[usd]'") from None


@contextmanager
def heard(pxr: Any) -> Iterator[list[str]]:
    """Collects USD's diagnostics for stderr; fills the list at the end of the block."""
    delegate, messages = pxr.UsdUtils.CoalescingDiagnosticDelegate(), []
    try:
        yield messages
    finally:
        messages += [" ".join(entry.commentary.split()) for entry in delegate.TakeUncoalescedDiagnostics()]


def write_usd(
    path: Path,
    name: str,
    mesh: Mesh,
    positions: Float[np.ndarray, "v 3"],
    looks: Sequence[TexturedMaterial],
    *,
    metres_per_unit: float = 1.0,
    double_sided: bool = False,
) -> None:
    """Write `path` (.usda): default prim `name` of kind component with one Mesh, a GeomSubset per part.

    Normals and `primvars:st` (v up) are per corner, Y up, subdivision off. Textures are 8- or 16-bit files beside the
    stage: albedo sRGB, everything else raw; normals +Y. UDIM tiles are one texture with <UDIM> in its name, which the
    preview surface reads; the UVs must lie in their tiles. A mesh far from its origin has float32 points about a local
    origin, and a translation in double.
    """
    pxr = library()
    path.unlink(missing_ok=True)
    stage = pxr.Usd.Stage.CreateNew(str(path))
    pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.y)
    pxr.UsdGeom.SetStageMetersPerUnit(stage, metres_per_unit)
    root = pxr.UsdGeom.Xform.Define(stage, f"/{name}")
    stage.SetDefaultPrim(root.GetPrim())
    _titled(root, path.stem)
    pxr.Usd.ModelAPI(root.GetPrim()).SetKind(pxr.Kind.Tokens.component)
    pxr.UsdGeom.Scope.Define(stage, f"/{name}/Materials")
    shape = pxr.UsdGeom.Mesh.Define(stage, f"/{name}/Mesh")
    origin = local_origin(positions)
    points = np.ascontiguousarray(positions - origin, np.float32)
    if origin.any():
        shape.AddTranslateOp(pxr.UsdGeom.XformOp.PrecisionDouble).Set(pxr.Gf.Vec3d(*origin.tolist()))
    shape.CreatePointsAttr(pxr.Vt.Vec3fArray.FromNumpy(points))
    shape.CreateFaceVertexCountsAttr(pxr.Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    shape.CreateFaceVertexIndicesAttr(pxr.Vt.IntArray.FromNumpy(mesh.faces.reshape(-1).astype(np.int32)))
    shape.CreateSubdivisionSchemeAttr(pxr.UsdGeom.Tokens.none)
    if double_sided:
        shape.CreateDoubleSidedAttr(True)
    shape.CreateExtentAttr(
        pxr.Vt.Vec3fArray([pxr.Gf.Vec3f(*points.min(axis=0).tolist()), pxr.Gf.Vec3f(*points.max(axis=0).tolist())])
    )
    normals = np.ascontiguousarray(mesh.corner_normals.reshape(-1, 3), np.float32)
    shape.CreateNormalsAttr(pxr.Vt.Vec3fArray.FromNumpy(normals))
    shape.SetNormalsInterpolation(pxr.UsdGeom.Tokens.faceVarying)
    st = pxr.UsdGeom.PrimvarsAPI(shape).CreatePrimvar(
        "st", pxr.Sdf.ValueTypeNames.TexCoord2fArray, pxr.UsdGeom.Tokens.faceVarying
    )
    st.Set(pxr.Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(mesh.corner_uvs.reshape(-1, 2), np.float32)))
    for part, look in enumerate(looks):
        material = define_material(pxr, stage, f"/{name}/Materials/{look.name}", look)
        faces = np.flatnonzero(mesh.part == part).astype(np.int32)
        subset = pxr.UsdGeom.Subset.CreateGeomSubset(
            shape, look.name, pxr.UsdGeom.Tokens.face, pxr.Vt.IntArray.FromNumpy(faces), "materialBind"
        )
        _titled(subset, look.title)
        pxr.UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(material)
    pxr.UsdShade.MaterialBindingAPI(shape).SetMaterialBindSubsetsFamilyType(pxr.UsdGeom.Tokens.partition)
    stage.GetRootLayer().Save()


def define_material(pxr: Any, stage: Any, place: str, look: TexturedMaterial, primvar: str = "st") -> Any:
    """A preview surface with the four textures of a look at the UVs `primvar`."""
    material = pxr.UsdShade.Material.Define(stage, place)
    _titled(material, look.title)
    surface = _shader(pxr, stage, f"{place}/Surface", "UsdPreviewSurface")
    reader = _shader(pxr, stage, f"{place}/UVs", "UsdPrimvarReader_float2")
    reader.CreateInput("varname", pxr.Sdf.ValueTypeNames.String).Set(primvar)
    uv = reader.CreateOutput("result", pxr.Sdf.ValueTypeNames.Float2)
    sockets = (
        ("diffuseColor", look.albedo, "rgb", pxr.Sdf.ValueTypeNames.Color3f, "sRGB" if look.srgb else "raw"),
        ("roughness", look.roughness, "r", pxr.Sdf.ValueTypeNames.Float, "raw"),
        ("metallic", look.metallic, "r", pxr.Sdf.ValueTypeNames.Float, "raw"),
        ("normal", look.normal, "rgb", pxr.Sdf.ValueTypeNames.Normal3f, "raw"),
    )
    if look.height is not None:
        sockets += (("displacement", look.height.file, "r", pxr.Sdf.ValueTypeNames.Float, "raw"),)
    for name, file, channel, kind, space in sockets:
        texture = _shader(pxr, stage, f"{place}/{name}", "UsdUVTexture")
        file_input = texture.CreateInput("file", pxr.Sdf.ValueTypeNames.Asset)
        file_input.Set(f"./{file}")
        if name == "diffuseColor" and not look.srgb and look.space is not None:
            # The preview surface supports raw and sRGB only; the attribute's metadata names the actual space.
            file_input.GetAttr().SetColorSpace(look.space.interop or look.space.name)
        texture.CreateInput("st", pxr.Sdf.ValueTypeNames.Float2).ConnectToSource(uv)
        texture.CreateInput("sourceColorSpace", pxr.Sdf.ValueTypeNames.Token).Set(space)
        for side in ("wrapS", "wrapT"):
            texture.CreateInput(side, pxr.Sdf.ValueTypeNames.Token).Set("repeat")
        if name == "normal":
            # n = 2 c - 1, which 8-bit files require.
            texture.CreateInput("scale", pxr.Sdf.ValueTypeNames.Float4).Set((2, 2, 2, 1))
            texture.CreateInput("bias", pxr.Sdf.ValueTypeNames.Float4).Set((-1, -1, -1, 0))
        if name == "displacement" and look.height is not None:
            scale, middle = look.height.scale, look.height.middle
            texture.CreateInput("scale", pxr.Sdf.ValueTypeNames.Float4).Set((scale,) * 4)
            texture.CreateInput("bias", pxr.Sdf.ValueTypeNames.Float4).Set((-middle * scale,) * 4)
        if name == "diffuseColor" and look.light.alpha:
            texture.CreateInput("scale", pxr.Sdf.ValueTypeNames.Float4).Set((1, 1, 1, look.light.opacity))
            coverage = texture.CreateOutput("a", pxr.Sdf.ValueTypeNames.Float)
            surface.CreateInput("opacity", pxr.Sdf.ValueTypeNames.Float).ConnectToSource(coverage)
        output = texture.CreateOutput(
            channel, pxr.Sdf.ValueTypeNames.Float3 if len(channel) > 1 else pxr.Sdf.ValueTypeNames.Float
        )
        surface.CreateInput(name, kind).ConnectToSource(output)
    _set_light(pxr, surface, look.light)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", pxr.Sdf.ValueTypeNames.Token))
    if look.height is not None:
        moves = surface.CreateOutput("displacement", pxr.Sdf.ValueTypeNames.Token)
        material.CreateDisplacementOutput().ConnectToSource(moves)
    return material


def _set_light(pxr: Any, surface: Any, light: Transparency) -> None:
    """Opacity without a texture, the threshold of a cut-out material, and emission."""
    if light.opacity < 1 and not light.alpha:
        surface.CreateInput("opacity", pxr.Sdf.ValueTypeNames.Float).Set(light.opacity)
    if light.cutoff is not None and (light.alpha or light.opacity < 1):
        surface.CreateInput("opacityThreshold", pxr.Sdf.ValueTypeNames.Float).Set(light.cutoff)
    if any(light.emission):
        surface.CreateInput("emissiveColor", pxr.Sdf.ValueTypeNames.Color3f).Set(light.emission)


def _titled(schema: Any, title: str) -> None:
    """Set the user's name as display name where the prim's differs."""
    if title not in ("", schema.GetPrim().GetName()):
        schema.GetPrim().SetDisplayName(title)


def _shader(pxr: Any, stage: Any, place: str, kind: str) -> Any:
    shader = pxr.UsdShade.Shader.Define(stage, place)
    shader.CreateIdAttr(kind)
    return shader


def write_usdz(path: Path, stage: Path) -> None:
    """Write the stage and its dependencies as one package."""
    pxr = library()
    path.unlink(missing_ok=True)
    if not pxr.UsdUtils.CreateNewUsdzPackage(pxr.Sdf.AssetPath(str(stage)), str(path)):
        raise MistyleError(f"{path}: USD could not package {stage.name}; are all textures beside it?")
    without_times(path)


def without_times(archive: Path) -> None:
    """Set the time of every file in an archive to zip's first day, 1980-01-01, in place, so that equal content gives
    equal bytes. Names outside ASCII get the UTF-8 flag."""
    with zipfile.ZipFile(archive) as package:
        entries, place = package.infolist(), package.start_dir
    with open(archive, "rb+") as file:

        def mark(flags: int, day: int, name: str) -> None:
            file.seek(day)
            file.write(FIRST_DAY)
            if not name.isascii():
                file.seek(flags)
                (bits,) = struct.unpack("<H", file.read(2))
                file.seek(flags)
                file.write(struct.pack("<H", bits | UTF8))

        for entry in entries:  # local file header: flags at byte 6, time and date at byte 10
            mark(entry.header_offset + 6, entry.header_offset + 10, entry.filename)
        for entry in entries:  # central directory header: flags at byte 8, time at byte 12, three lengths at byte 28
            mark(place + 8, place + 12, entry.filename)
            file.seek(place + 28)
            place += 46 + sum(struct.unpack("<HHH", file.read(6)))


def complaints(path: Path) -> list[str]:
    """Errors of USD's own validators for a stage; empty without errors."""
    pxr = library()
    stage = pxr.Usd.Stage.Open(str(path))
    registry = pxr.UsdValidation.ValidationRegistry()
    context = pxr.UsdValidation.ValidationContext(registry.GetOrLoadAllValidators())
    errors = context.Validate(stage)
    serious = (pxr.UsdValidation.ValidationErrorType.Error,)
    return [f"{e.GetName()}: {e.GetMessage()}" for e in errors if e.GetType() in serious]
