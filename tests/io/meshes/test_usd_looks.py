"""What a USD file says about looks: bindings by purpose, wrap modes, primvars of every kind, display colours."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from mistyle.io.meshes.parsed_mesh import Raw
from mistyle.io.read_mesh import read_mesh
from mistyle.io.usd.read import read_usd
from mistyle.io.usd.stage import metres

pxr = pytest.importorskip("pxr")

COLOURS = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0]], float)
UVS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
TRIANGLES = [[0, 1, 2], [0, 2, 3]]  # of the polygon's corners
API = 'prepend apiSchemas = ["MaterialBindingAPI"]'


def listed(values: np.ndarray) -> str:
    return "[" + ", ".join("(" + ", ".join(map(str, row)) + ")" for row in values.tolist()) + "]"


def primvar(name: str, kind: str, values: np.ndarray, interpolation: str) -> str:
    return f'    {kind}[] primvars:{name} = {listed(values)} ( interpolation = "{interpolation}" )\n'


ST = primvar("st", "texCoord2f", UVS, "vertex")
BOUND = "    rel material:binding = </R/M>\n"


def plate(extra: str, uvs: str = ST) -> str:
    return (
        f'def Mesh "Q" ( {API} )\n{{\n    int[] faceVertexCounts = [4]\n    int[] faceVertexIndices = [0, 1, 2, 3]\n'
        "    point3f[] points = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]\n"
        f'    uniform token subdivisionScheme = "none"\n{uvs}{extra}}}\n'
    )


def material(inputs: str, shaders: str = "", name: str = "M") -> str:
    return (
        f'def Material "{name}"\n{{\n    token outputs:surface.connect = </R/{name}/S.outputs:surface>\n'
        f'    def Shader "S"\n    {{\n        uniform token info:id = "UsdPreviewSurface"\n{inputs}'
        f"        token outputs:surface\n    }}\n{shaders}}}\n"
    )


def texture(more: str = "") -> tuple[str, str]:
    shaders = (
        '    def Shader "P"\n    {\n        uniform token info:id = "UsdPrimvarReader_float2"\n'
        '        string inputs:varname = "st"\n        float2 outputs:result\n    }\n'
        '    def Shader "T"\n    {\n        uniform token info:id = "UsdUVTexture"\n'
        f"        asset inputs:file = @wood.png@\n{more}"
        "        float2 inputs:st.connect = </R/M/P.outputs:result>\n        float3 outputs:rgb\n    }\n"
    )
    return "        color3f inputs:diffuseColor.connect = </R/M/T.outputs:rgb>\n", shaders


def read(folder: Path, *parts: str) -> Raw:
    return read_usd(write(folder, *parts), 100)


def write(folder: Path, *parts: str) -> Path:
    path = folder / "a.usda"
    head = '#usda 1.0\n(\n    defaultPrim = "R"\n    upAxis = "Y"\n    metersPerUnit = 1\n)\ndef Xform "R"\n{\n'
    path.write_text(head + "".join(parts) + "}\n")
    return path


RED = material("        color3f inputs:diffuseColor = (0.8, 0.1, 0.1)\n")
BLUE = material("        color3f inputs:diffuseColor = (0.1, 0.1, 0.8)\n", name="B")
FOR_BLUE = "    rel material:binding:{} = </R/B>\n"


@pytest.mark.parametrize(
    ("bindings", "name"),
    [
        (BOUND, "M"),
        (FOR_BLUE.format("full"), "B"),
        (FOR_BLUE.format("preview"), "B"),
        (BOUND + FOR_BLUE.format("preview"), "B"),
        (BOUND + FOR_BLUE.format("full"), "M"),
        ("", "material"),
    ],
)
def test_bindings_by_purpose(bindings: str, name: str, tmp_path: Path) -> None:
    found = read(tmp_path, plate(bindings), RED, BLUE)
    assert [m.name for m in found.materials] == [name]
    assert any("only for full renders" in note for note in found.notes) == (bindings == FOR_BLUE.format("full"))


@pytest.mark.parametrize(
    "kind",
    ["texCoord2f", "texCoord2d", "texCoord2h", "texCoord3f", "texCoord3d", "float2", "float3", "half2", "double3"],
)
def test_coordinates_of_every_type(kind: str, tmp_path: Path) -> None:
    values = UVS if "2" in kind else np.c_[UVS, np.full(4, 7.0)]
    found = read(tmp_path, plate("", primvar("st", kind, values, "vertex")))
    assert found.uvs is not None
    assert found.uvs.tolist() == UVS[TRIANGLES].tolist()


@pytest.mark.parametrize("interpolation", ["vertex", "varying", "faceVarying", "uniform", "constant"])
def test_display_colours_of_every_interpolation(interpolation: str, tmp_path: Path) -> None:
    values = COLOURS if interpolation not in ("uniform", "constant") else COLOURS[:1]
    found = read(tmp_path, plate(primvar("displayColor", "color3f", values, interpolation)))
    if len(values) == 1:
        assert found.colours is None and found.materials[0].albedo_factor == (1, 0, 0)
    else:
        assert found.colours is not None and found.materials[0].albedo_factor == (1, 1, 1)
        assert found.colours.tolist() == COLOURS[TRIANGLES].tolist()


def test_indexed_and_inherited_display_colours(tmp_path: Path) -> None:
    indexed = primvar("displayColor", "color3f", COLOURS[:2], "vertex")
    indexed += "    int[] primvars:displayColor:indices = [0, 1, 1, 0]\n"
    found = read(tmp_path, plate(indexed))
    assert found.colours is not None
    assert found.colours.tolist() == COLOURS[[0, 1, 1, 0]][TRIANGLES].tolist()
    above = primvar("displayColor", "color3f", COLOURS[2:3], "constant")
    assert read(tmp_path, above, plate("")).materials[0].albedo_factor == (0, 0, 1)


def test_a_material_comes_before_the_display_colour(tmp_path: Path) -> None:
    found = read(tmp_path, plate(BOUND + primvar("displayColor", "color3f", COLOURS, "vertex")), RED)
    assert found.colours is None and found.materials[0].albedo_factor == pytest.approx((0.8, 0.1, 0.1))


def test_a_material_may_read_its_colour_from_a_primvar(tmp_path: Path) -> None:
    reader = '    def Shader "C"\n    {\n        uniform token info:id = "UsdPrimvarReader_float3"\n'
    reader += '        string inputs:varname = "paint"\n        float3 outputs:result\n    }\n'
    inputs = "        color3f inputs:diffuseColor.connect = </R/M/C.outputs:result>\n"
    found = read(tmp_path, plate(BOUND + primvar("paint", "color3f", COLOURS, "faceVarying")), material(inputs, reader))
    assert found.colours is not None and found.materials[0].albedo_factor == (1, 1, 1)
    assert found.colours.tolist() == COLOURS[TRIANGLES].tolist()


def test_display_colours_become_the_albedo(tmp_path: Path) -> None:
    path = write(tmp_path, plate(primvar("displayColor", "color3f", COLOURS, "vertex")))
    (found,) = read_mesh(path, uv="keep", size=32).materials
    assert found.albedo is not None
    corners = found.albedo[[-1, -1, 0, 0], [0, -1, -1, 0]]
    assert corners == pytest.approx(COLOURS, abs=0.05)


@pytest.mark.parametrize("mode", ["repeat", "mirror", "clamp", "black", "useMetadata", None])
def test_wrap_modes(mode: str | None, tmp_path: Path) -> None:
    """A texture of two columns, red and green, along u from 0 to 2."""
    Image.fromarray(np.array([[[255, 0, 0], [0, 255, 0]]] * 2, np.uint8)).save(tmp_path / "wood.png")
    said = "" if mode is None else f'        token inputs:wrapS = "{mode}"\n        token inputs:wrapT = "repeat"\n'
    uvs = primvar("st", "texCoord2f", UVS * [2, 1], "vertex")
    path = write(tmp_path, plate(BOUND, uvs), material(*texture(said)))
    (entry,) = read_usd(path, 100).materials[0].load(1001)[0].values()
    expected = {"mirror": "mirror", "clamp": "clamp", "black": "clamp"}.get(mode or "", "repeat")
    assert entry.wrap == (expected, "repeat")
    notes = " ".join(read_mesh(path).source.notes)
    assert ("is black outside" in notes) == (mode == "black")
    assert ("has no wrap mode" in notes) == (mode in ("useMetadata", None))


def test_wrap_modes_say_nothing_inside_the_square(tmp_path: Path) -> None:
    Image.new("RGB", (2, 2), (255, 0, 0)).save(tmp_path / "wood.png")
    for mode in ("black", "mirror", "useMetadata"):
        found = read(tmp_path, plate(BOUND), material(*texture(f'        token inputs:wrapS = "{mode}"\n')))
        assert found.notes == ()


def test_what_is_not_painted_is_said(tmp_path: Path) -> None:
    inputs = "        int inputs:useSpecularWorkflow = 1\n        color3f inputs:specularColor = (1, 0, 0)\n"
    inputs += "        float inputs:metallic = 1\n        color3f inputs:emissiveColor = (0, 2, 0)\n"
    inputs += "        float inputs:clearcoat = 0.5\n        float inputs:opacity = 0.5\n"
    see_through = "    float[] primvars:displayOpacity = [0.5]\n"
    found = read(tmp_path, plate(BOUND + see_through), material(inputs))
    assert found.materials[0].metallic_factor == 0
    told = " ".join(found.notes)
    assert (
        "specular workflow" in told
        and "emissiveColor and clearcoat and opacity of material 'M' shows in lookdev" in told
    )
    shading = found.materials[0].shading
    assert (shading.opacity, shading.emission, shading.coat, shading.specular) == (0.5, (0, 2, 0), 0.5, (1, 0, 0))
    assert "displayOpacity" not in told
    assert read(tmp_path, plate(see_through)).materials[0].shading.opacity == 0.5
    varied = see_through.replace("[0.5]", "[0.5, 1, 1, 1]")
    assert any("displayOpacity was not read" in note for note in read(tmp_path, plate(varied)).notes)
    neutral = "        color3f inputs:emissiveColor = (0, 0, 0)\n        float inputs:opacity = 1\n"
    assert read(tmp_path, plate(BOUND), material(neutral)).notes == ()


def test_opacity_and_emission_of_textures(tmp_path: Path) -> None:
    """A cut-out by a texture's alpha; emission and a roughness that the file calls sRGB by its colours."""
    Image.new("RGBA", (2, 2), (188, 255, 255, 51)).save(tmp_path / "wood.png")
    inputs, shaders = texture(
        '        token inputs:sourceColorSpace = "sRGB"\n        float outputs:a\n        float outputs:r\n'
    )
    inputs += "        color3f inputs:emissiveColor.connect = </R/M/T.outputs:rgb>\n"
    inputs += "        float inputs:opacity.connect = </R/M/T.outputs:a>\n        float inputs:opacityThreshold = 0.3\n"
    inputs += "        float inputs:roughness.connect = </R/M/T.outputs:r>\n"
    found = read(tmp_path, plate(BOUND), material(inputs, shaders)).materials[0]
    maps = {name: entry.values[0, 0] for name, entry in found.load(1001)[0].items()}
    assert maps["opacity"] == pytest.approx(0.2) and found.shading.cutoff == pytest.approx(0.3)
    assert maps["emission"] == pytest.approx([0.503, 1, 1], abs=1e-3) and found.shading.emission == (1, 1, 1)
    assert maps["roughness"] == pytest.approx(0.503, abs=1e-3)


AREAS = {
    "Sphere": ("double radius = 2", 4 * np.pi * 4),
    "Cube": ("double size = 3", 6 * 9),
    "Cylinder": ("double radius = 2\n double height = 3", 2 * np.pi * 2 * 3 + 2 * np.pi * 4),
    "Cone": ("double radius = 3\n double height = 4", np.pi * 3 * 5 + np.pi * 9),
    "Capsule": ("double radius = 1\n double height = 2", 4 * np.pi + 2 * np.pi * 2),
    "Plane": ("double width = 2\n double length = 3", 6),
}


@pytest.mark.parametrize("axis", ["X", "Y", "Z"])
@pytest.mark.parametrize("kind", sorted(AREAS))
def test_shapes_have_their_area_and_face_outwards(kind: str, axis: str, tmp_path: Path) -> None:
    said, area = AREAS[kind]
    said += "" if kind in ("Sphere", "Cube") else f'\n uniform token axis = "{axis}"'
    found = read_usd(write(tmp_path, f'def {kind} "S"\n{{\n {said}\n}}\n'), 10_000)
    corners = found.positions[found.faces]
    vectors = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    assert np.linalg.norm(vectors, axis=1).sum() == pytest.approx(area, rel=5e-3)
    assert found.normals is not None and (np.einsum("fc,fkc->fk", vectors, found.normals) > 0).all()
    if kind != "Plane":
        assert (np.einsum("fc,fkc->fk", vectors, corners) > -1e-9).all()
    assert any("other than meshes" in note for note in found.notes)


RIG = """
def SkelRoot "Rig"
{
    def Skeleton "Bones" ( prepend apiSchemas = ["SkelBindingAPI"] )
    {
        uniform token[] joints = ["a"]
        uniform matrix4d[] bindTransforms = [( (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1) )]
        uniform matrix4d[] restTransforms = [( (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1) )]
        rel skel:animationSource = </R/Rig/Move>
    }
    def SkelAnimation "Move"
    {
        uniform token[] joints = ["a"]
        quatf[] rotations = [(1, 0, 0, 0)]
        half3[] scales = [(1, 1, 1)]
        float3[] translations.timeSamples = {
            3: [(0, 0, 5)],
            9: [(0, 0, 7)],
        }
    }
"""
SKIN = """
    rel skel:skeleton = </R/Rig/Bones>
    matrix4d primvars:skel:geomBindTransform = ( (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1) )
    int[] primvars:skel:jointIndices = [0] (
        interpolation = "constant"
        elementSize = 1
    )
    float[] primvars:skel:jointWeights = [1] (
        interpolation = "constant"
        elementSize = 1
    )
"""


def test_a_skeleton_poses_its_mesh(tmp_path: Path) -> None:
    """One joint, moved by its animation's first sample."""
    body = plate(SKIN).replace(API, 'prepend apiSchemas = ["SkelBindingAPI"]')
    found = read(tmp_path, f"{RIG}{body}}}\n")
    assert found.positions[:, 2] == pytest.approx(np.full(4, 5.0))
    assert any("pose of its skeleton" in note for note in found.notes)


def test_a_cage_is_shaded_smooth_and_a_polygon_mesh_is_not(tmp_path: Path) -> None:
    none = read(tmp_path, plate(""))
    cage = read(tmp_path, plate("").replace('"none"', '"catmullClark"'))
    assert none.normals is None and cage.normals == pytest.approx(np.tile([0, 0, 1.0], (2, 3, 1)))


def test_a_unit_of_another_type_counts(tmp_path: Path) -> None:
    """A file may hold the unit as a float, which USD refuses to give as the double that it should be."""
    stage = pxr.Usd.Stage.Open(str(write(tmp_path, plate(""))))

    def refuses(_: object) -> float:
        raise error

    with pytest.raises(pxr.Tf.ErrorException) as caught:
        pxr.Usd.Stage.Open(str(tmp_path / "none.usda"))
    error = caught.value
    stage.GetRootLayer().pseudoRoot.SetInfo("metersPerUnit", 2.0)
    stub = SimpleNamespace(UsdGeom=SimpleNamespace(GetStageMetersPerUnit=refuses), Tf=pxr.Tf)
    assert metres(stub, stage) == 2.0


def test_an_unknown_shader_is_said(tmp_path: Path) -> None:
    inputs = "        color3f inputs:diffuseColor.connect = </R/M/X.outputs:rgb>\n"
    shader = (
        '    def Shader "X"\n    {\n        uniform token info:id = "ND_noise"\n        float3 outputs:rgb\n    }\n'
    )
    assert any("ND_noise" in note for note in read(tmp_path, plate(BOUND), material(inputs, shader)).notes)


def test_each_material_has_its_own_coordinates(tmp_path: Path) -> None:
    """A subset's texture is looked up at its own primvar, the rest of the mesh at another."""
    Image.new("RGB", (2, 2), (255, 0, 0)).save(tmp_path / "wood.png")
    inputs, shaders = texture()
    other = material(inputs, shaders).replace('"st"', '"other"').replace("/R/M/", "/R/O/").replace('"M"', '"O"')
    subset = f'    def GeomSubset "G" ( {API} )\n    {{\n        uniform token elementType = "face"\n'
    subset += '        uniform token familyName = "materialBind"\n        int[] indices = [1]\n'
    subset += "        rel material:binding = </R/O>\n    }\n"
    body = plate(BOUND + primvar("other", "texCoord2f", UVS / 2, "vertex") + subset)
    body = body.replace("[4]", "[3, 3]").replace("[0, 1, 2, 3]", "[0, 1, 2, 0, 2, 3]")
    found = read(tmp_path, body, material(inputs, shaders), other)
    assert found.uvs is not None and [found.materials[m].name for m in found.material] == ["M", "O"]
    assert found.uvs.tolist() == [UVS[[0, 1, 2]].tolist(), (UVS / 2)[[0, 2, 3]].tolist()]


def test_maps_of_one_material_have_their_own_coordinates(tmp_path: Path) -> None:
    """Roughness at another primvar, at which the picture stands upside down."""
    pixels = np.full((8, 8, 3), 50, np.uint8)
    pixels[:4] = 200  # above
    Image.fromarray(pixels).save(tmp_path / "wood.png")
    inputs, shaders = texture()
    inputs += "        float inputs:roughness.connect = </R/M/T2.outputs:r>\n"
    second = shaders.replace('"P"', '"P2"').replace('"T"', '"T2"').replace("/M/P.", "/M/P2.").replace('"st"', '"other"')
    second = second.replace("float3 outputs:rgb", "float outputs:r")
    body = plate(BOUND + primvar("other", "texCoord2f", UVS * [1, -1] + [0, 1], "vertex"))
    path = write(tmp_path, body, material(inputs, shaders + second))
    (found,) = read_mesh(path, uv="keep", size=8).materials
    assert found.albedo is not None and found.roughness is not None
    assert found.albedo[1, 4, 0] > found.albedo[6, 4, 0]
    assert found.roughness[1, 4] == pytest.approx(50 / 255, abs=0.01)
    assert found.roughness[6, 4] == pytest.approx(200 / 255, abs=0.01)
    lost = read_mesh(write(tmp_path, plate(BOUND), material(inputs, shaders + second)), uv="keep", size=8)
    assert lost.materials[0].roughness is None and any("roughness map" in note for note in lost.source.notes)


def test_a_mesh_without_any_colour_is_noted_as_white(tmp_path: Path) -> None:
    path = tmp_path / "a.usda"
    for extra, noted in (("", True), (primvar("displayColor", "color3f", COLOURS[:1], "constant"), False)):
        path.write_text("#usda 1.0\n" + plate(extra))
        notes = read_usd(path, 100).notes
        assert any("neither a material nor a display colour" in note for note in notes) == noted


def subset(name: str, face: int, bound: str) -> str:
    return (
        f'    def GeomSubset "{name}" ( {API} )\n    {{\n        uniform token elementType = "face"\n'
        f'        uniform token familyName = "materialBind"\n        int[] indices = [{face}]\n'
        f"        rel material:binding = <{bound}>\n    }}\n"
    )


def two_plates(extra: str) -> str:
    """Two quads, one above the other, as one mesh."""
    points = [(x, y, z) for z in (0, 1) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return (
        f'def Mesh "Q" ( {API} )\n{{\n    int[] faceVertexCounts = [4, 4]\n'
        f"    int[] faceVertexIndices = [0, 1, 2, 3, 4, 5, 6, 7]\n    point3f[] points = {points}\n"
        f'    uniform token subdivisionScheme = "none"\n'
        f"{primvar('st', 'texCoord2f', np.r_[UVS, UVS] / 4, 'vertex')}{extra}}}\n"
    )


MISSING = "bound materials are missing on the stage: /Materials/front, /Materials/back"


def test_materials_of_another_layer_keep_their_slots(tmp_path: Path) -> None:
    family = '    uniform token subsetFamily:materialBind:familyType = "partition"\n'
    parts = subset("f", 0, "/Materials/front") + subset("b", 1, "/Materials/back")
    found = read(tmp_path, two_plates(family + parts))
    assert [m.name for m in found.materials] == ["front", "back"] and found.material.tolist() == [0, 0, 1, 1]
    (note,) = (n for n in found.notes if "missing" in n)
    assert MISSING in note
    assert not any("neither a material" in n for n in found.notes)


def test_a_mesh_of_a_missing_material_has_its_name(tmp_path: Path) -> None:
    found = read(tmp_path, plate("    rel material:binding = </Materials/paint>\n"))
    assert [m.name for m in found.materials] == ["paint"]
    assert any(n.startswith("A bound material is missing on the stage: /Materials/paint.") for n in found.notes)
    # Inherited, with the display colour of the mesh.
    above = '    rel material:binding = </Materials/paint>\n    uniform token purpose = "default"\n'
    colour = primvar("displayColor", "color3f", COLOURS[:1], "constant")
    group = f'def Xform "G" ( {API} )\n{{\n{above}{plate(colour)}}}\n'
    (material_found,) = read(tmp_path, group).materials
    assert (material_found.name, material_found.albedo_factor) == ("paint", (1, 0, 0))


def test_a_look_binds_the_subsets_of_the_source(tmp_path: Path) -> None:
    from mistyle.io.materialx import TexturedMaterial
    from mistyle.io.usd.look import write_look
    from mistyle.io.usd.write import complaints

    parts = subset("f", 0, "/Materials/front") + subset("b", 1, "/Materials/back")
    path = write(tmp_path, two_plates(parts))
    asset = read_mesh(path, uv="keep", size=16)
    looks = [TexturedMaterial(p, f"{p}_a.png", f"{p}_n.png", f"{p}_r.png", f"{p}_m.png") for p in asset.mesh.parts]
    for part in asset.mesh.parts:
        for k in "anrm":
            Image.new("RGB", (2, 2)).save(tmp_path / f"{part}_{k}.png")
    layer = tmp_path / "look.usda"
    write_look(layer, None, asset, looks, "wave", beside=tmp_path)
    assert "active = false" not in layer.read_text() and complaints(layer) == []
    stage = pxr.Usd.Stage.Open(str(layer))
    api = pxr.UsdShade.MaterialBindingAPI
    bound = {
        s.GetPrim().GetName(): str(api(s.GetPrim()).ComputeBoundMaterial()[0].GetPath())
        for s in api(stage.GetPrimAtPath("/R/Q")).GetMaterialBindSubsets()
    }
    assert bound == {"f": "/R/look/front", "b": "/R/look/back"}


MOVES = (
    "    double3 xformOp:translate.timeSamples = { 1: (0, 0, 0), 24: (0, 1, 0) }\n"
    '    uniform token[] xformOpOrder = ["xformOp:translate"]\n'
)
VARIANTS = 'def Xform "V" ( variants = { string finish = "a" }\n    prepend variantSets = "finish" )\n'
VARIANTS += '{\n    variantSet "finish" = { "a" { } "b" { } }\n}\n'


@pytest.mark.parametrize(
    ("extra", "around", "held"),
    [
        ("", "", None),
        (MOVES, "", "an animation (moving prims: 1)"),
        ("", 'def Camera "C" {}\ndef Camera "D" {}\ndef SphereLight "L" {}\n', "cameras (2) and lights (1)"),
        ("", VARIANTS, "further variants of 'finish'"),
    ],
)
def test_contents_that_stay_in_the_file_are_noted(extra: str, around: str, held: str | None, tmp_path: Path) -> None:
    from mistyle.deliver.losses import source_losses

    notes = read(tmp_path, plate(extra), around).notes
    sentences = source_losses(notes, ["glb", "usd", "obj", "maps"])
    assert sentences == (() if held is None else (f"GLB and OBJ lack {held}, which the USD source has.",))
    assert source_losses(notes, ["usd", "maps"]) == ()


def test_a_skin_and_its_animation_are_noted(tmp_path: Path) -> None:
    rig = 'def Skeleton "S" {}\ndef SkelAnimation "A"\n{\n    float3[] translations.timeSamples = '
    rig += "{ 1: [(0, 0, 0)], 2: [(0, 1, 0)] }\n}\n"
    binding = f'def Mesh "W" ( prepend apiSchemas = ["SkelBindingAPI"] )\n{{\n{ST}}}\ndef BlendShape "B" {{}}\n'
    held = "a skin and its skeleton, blend shapes (1) and an animation (moving skeletons: 1)"
    assert f"The USD file has {held}, which the asset lacks." in read(tmp_path, plate(""), rig, binding).notes


def test_an_object_has_the_last_part_of_its_path(tmp_path: Path) -> None:
    from mistyle.io.meshes.objects import objects

    second = f'def Xform "G"\n{{\n{plate("")}}}\n'
    asset = read_mesh(write(tmp_path, plate(""), second), uv="auto", size=16)
    number, names = objects(asset)
    assert names == ["Q", "Q_2"] and number.tolist() == [0, 0, 1, 1]
    assert [p.name for p in asset.source.primitives] == ["/R/Q", "/R/G/Q"]
