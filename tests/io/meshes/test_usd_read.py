"""USD read as meshes: geometry by closed forms, materials by their pixels, hostile stages by a sentence."""

import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mistyle.core.errors import InputRefused
from mistyle.core.image import linear_from_srgb
from mistyle.geometry.normals import area_vectors
from mistyle.io.read_mesh import read_mesh
from mistyle.io.usd.read import read_usd
from tests.support.gltf_cases import bumpy_sphere, no_texels, quarters

pxr = pytest.importorskip("pxr")

HEAD = '#usda 1.0\n(\n    defaultPrim = "Root"\n    upAxis = "{axis}"\n    metersPerUnit = {unit}\n{more})\n'
# A unit square in the plane z = 0, seen from +Z, and a triangle above it.
MESH = """
def Mesh "{name}" ({api})
{{
    uniform token subdivisionScheme = "none"
    uniform token orientation = "{orientation}"
    point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0.5, 2, 0)]
    int[] faceVertexCounts = [4, 3]
    int[] faceVertexIndices = [{indices}]
    {extra}
}}
"""
INDICES = "0, 1, 2, 3, 3, 2, 4"
INDEXED = """
    texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 0.5), (0, 0.5), (0.5, 1)] ( interpolation = "faceVarying" )
    int[] primvars:st:indices = [0, 1, 2, 3, 3, 2, 4]
"""
VERTEX = """
    texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 0.5), (0, 0.5), (0.5, 1)] ( interpolation = "vertex" )
"""


def mesh(name="Plate", orientation="rightHanded", indices=INDICES, extra=INDEXED, api=""):
    return MESH.format(name=name, orientation=orientation, indices=indices, extra=extra, api=api)


def stage(path: Path, body: str, axis="Y", unit="1", more="") -> Path:
    head = HEAD.format(axis=axis, unit=unit, more=more)
    path.write_text(head + 'def Xform "Root"\n{\n' + body + "\n}\n")
    return path


def raw(path: Path, faces: int = 10_000):
    return read_usd(path, faces)


def normal_of(found) -> np.ndarray:
    vectors = area_vectors(found.positions, found.faces)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.mark.parametrize("extra", [INDEXED, VERTEX])
def test_polygons_become_triangles_with_their_uvs(tmp_path, extra):
    found = raw(stage(tmp_path / "a.usda", mesh(extra=extra)))
    assert len(found.faces) == 3 and len(found.positions) == 5
    np.testing.assert_allclose(normal_of(found), np.tile([0, 0, 1], (3, 1)), atol=1e-12)
    # u = x and v = y / 2 everywhere.
    corners = found.positions[found.faces]
    np.testing.assert_allclose(found.uvs, np.stack([corners[..., 0], corners[..., 1] / 2], -1), atol=1e-6)


def test_axis_units_and_transforms_give_metres_with_y_up(tmp_path):
    turned = "    double3 xformOp:translate = (10, 20, 30)\n    float3 xformOp:scale = (2, 3, 4)\n"
    turned += '    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]\n'
    found = raw(stage(tmp_path / "a.usda", mesh(extra=INDEXED + turned), axis="Z", unit="0.01"))
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 2, 0]])
    x, y, z = (points * [2, 3, 4] + [10, 20, 30]).T * 0.01
    np.testing.assert_allclose(found.positions, np.stack([x, z, -y], 1), atol=1e-9)
    # What points to +Z up points to +Y up.
    np.testing.assert_allclose(normal_of(found), np.tile([0, 1, 0], (3, 1)), atol=1e-12)
    assert any("Z up" in note and "0.01 m" in note for note in found.notes)


@pytest.mark.parametrize(
    ("orientation", "scale", "up"), [("rightHanded", 1, 1), ("leftHanded", 1, -1), ("rightHanded", -1, 1)]
)
def test_winding_follows_orientation_and_mirrors(tmp_path, orientation, scale, up):
    extra = INDEXED + f"    float3 xformOp:scale = ({scale}, 1, 1)\n"
    extra += '    uniform token[] xformOpOrder = ["xformOp:scale"]\n'
    extra += '    normal3f[] normals = [(0, 0, 1)] ( interpolation = "constant" )\n'
    found = raw(stage(tmp_path / "a.usda", mesh(orientation=orientation, extra=extra)))
    np.testing.assert_allclose(normal_of(found)[:, 2], up, atol=1e-12)
    np.testing.assert_allclose(found.normals, np.broadcast_to([0, 0, 1], (3, 3, 3)), atol=1e-6)


def test_several_meshes_instances_and_what_is_hidden(tmp_path):
    body = mesh("One") + mesh("Two", extra=VERTEX + '    token visibility = "invisible"\n')
    body += mesh("Three", extra=INDEXED + '    uniform token purpose = "proxy"\n')
    body += 'def BasisCurves "Hair" {}\n'
    body += 'def Xform "A" ( instanceable = true\n references = </Proto> ) { double3 xformOp:translate = (5, 0, 0)\n'
    body += '    uniform token[] xformOpOrder = ["xformOp:translate"]\n}\n'
    body += 'def Xform "B" ( instanceable = true\n references = </Proto> ) {}\n'
    path = stage(tmp_path / "a.usda", body)
    path.write_text(path.read_text() + 'class "Proto" {' + mesh("Part") + "}\n")
    found = raw(path)
    assert [p.name for p in found.primitives] == ["/Root/One", "/Root/A/Part", "/Root/B/Part"]
    np.testing.assert_array_equal(found.twin, [0, 1, 2, 3, 4, 5, 3, 4, 5])
    np.testing.assert_allclose(found.positions[5:10] - found.positions[10:15], np.tile([5, 0, 0], (5, 1)))
    told = " ".join(found.notes)
    assert all(word in told for word in ("Invisible", "proxy", "not surfaces", "share their texels"))


def test_a_point_instancer_of_millions_costs_one_prototype(tmp_path):
    count = 200_000
    body = 'def PointInstancer "Many"\n{\n    rel prototypes = [</Root/Many/Leaf>]\n'
    body += f"    int[] protoIndices = [{', '.join(['0'] * count)}]\n"
    body += f"    point3f[] positions = [{', '.join(['(1, 2, 3)'] * count)}]\n"
    body += f"    quath[] orientations = [{', '.join(['(0.70710678, 0, 0, 0.70710678)'] * count)}]\n"
    found = raw(stage(tmp_path / "a.usda", body + mesh("Leaf") + "}\n"))
    assert len(found.faces) == 3 and any("point instancer" in note for note in found.notes)
    # A quarter turn about +Z, then the first instance's place.
    np.testing.assert_allclose(found.positions[1], [1, 3, 3], atol=2e-3)


MATERIALS = """
def Scope "Looks"
{
    def Material "red"
    {
        token outputs:surface.connect = </Root/Looks/red/S.outputs:surface>
        def Shader "S"
        {
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor = (0.8, 0.1, 0.05)
            float inputs:roughness = 0.3
            float inputs:metallic = 1
            token outputs:surface
        }
    }
    def Material "painted"
    {
        token outputs:surface.connect = </Root/Looks/painted/S.outputs:surface>
        def Shader "S"
        {
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor.connect = </Root/Looks/painted/T.outputs:rgb>
            float inputs:roughness.connect = </Root/Looks/painted/R.outputs:g>
            normal3f inputs:normal.connect = </Root/Looks/painted/N.outputs:rgb>
            token outputs:surface
        }
        def Shader "UV"
        {
            uniform token info:id = "UsdPrimvarReader_float2"
            string inputs:varname = "st"
            float2 outputs:result
        }
        def Shader "T"
        {
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @./colour.png@
            token inputs:sourceColorSpace = "sRGB"
            float2 inputs:st.connect = </Root/Looks/painted/UV.outputs:result>
            float3 outputs:rgb
        }
        def Shader "R"
        {
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @./colour.png@
            token inputs:sourceColorSpace = "raw"
            float4 inputs:scale = (1, 0.5, 1, 1)
            float4 inputs:bias = (0, 0.25, 0, 0)
            float2 inputs:st.connect = </Root/Looks/painted/UV.outputs:result>
            float outputs:g
        }
        def Shader "N"
        {
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @./normal.png@
            token inputs:sourceColorSpace = "raw"
            float4 inputs:scale = (2, -2, 2, 1)
            float4 inputs:bias = (-1, 1, -1, 0)
            float2 inputs:st.connect = </Root/Looks/painted/UV.outputs:result>
            float3 outputs:rgb
        }
    }
}
"""
SUBSET = """
    rel material:binding = </Root/Looks/red>
    def GeomSubset "top" ( prepend apiSchemas = ["MaterialBindingAPI"] )
    {
        uniform token elementType = "face"
        uniform token familyName = "materialBind"
        int[] indices = [1]
        rel material:binding = </Root/Looks/painted>
    }
"""


def painted(folder: Path) -> Path:
    pixels = np.zeros((4, 4, 3), np.uint8)
    pixels[:2, :2], pixels[2:, 2:] = (200, 100, 50), (10, 20, 30)
    Image.fromarray(pixels).save(folder / "colour.png")
    Image.fromarray(np.full((4, 4, 3), (128, 218, 218), np.uint8)).save(folder / "normal.png")
    api = 'prepend apiSchemas = ["MaterialBindingAPI"]'
    return stage(folder / "a.usda", mesh(extra=INDEXED + SUBSET, api=api) + MATERIALS)


def check_painted(found):
    red, texture = sorted(found.materials, key=lambda m: m.name, reverse=True)
    assert (red.name, red.albedo_factor, red.roughness_factor, red.metallic_factor) == (
        "red", pytest.approx((0.8, 0.1, 0.05)), pytest.approx(0.3), 1.0,
    )  # fmt: skip
    # The quad's two triangles are red, the subset's triangle is painted.
    assert [found.materials[m].name for m in found.material] == ["red", "red", "painted"]
    maps, notes = texture.load(1001)
    assert notes == ()
    colour = np.array([200, 100, 50], np.float32) / 255
    np.testing.assert_allclose(maps["albedo"].values[0, 0], linear_from_srgb(colour), atol=1e-6)
    np.testing.assert_allclose(maps["roughness"].values[0, 0], 0.25 + 0.5 * 100 / 255, atol=1e-6)
    # -Y by its scale and bias: green above the middle points down here.
    assert maps["normal"].values[0, 0, 1] < -0.5
    np.testing.assert_allclose(np.linalg.norm(maps["normal"].values, axis=-1), 1, atol=1e-6)
    assert texture.albedo_factor == (1.0, 1.0, 1.0) and texture.metallic_factor == 0.0


def test_preview_surfaces_of_subsets_and_their_textures(tmp_path):
    check_painted(raw(painted(tmp_path)))


def test_packages_are_read_without_unpacking(tmp_path):
    from pxr import Sdf, UsdUtils

    (tmp_path / "src").mkdir()
    target = tmp_path / "a.usdz"
    assert UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(painted(tmp_path / "src"))), str(target))
    check_painted(raw(target))


def test_binary_layers_references_and_variants(tmp_path):
    from pxr import Usd

    (tmp_path / "parts").mkdir()
    part = stage(tmp_path / "parts" / "part.usda", mesh())
    Usd.Stage.Open(str(part)).Export(str(tmp_path / "parts" / "part.usdc"))
    body = 'def "Ref" ( references = @./parts/part.usdc@ ) {}\n'
    body += 'def "Pay" ( payload = @./parts/part.usda@ ) {}\n'
    found = raw(stage(tmp_path / "a.usda", body))
    assert [p.name for p in found.primitives] == ["/Root/Ref/Plate", "/Root/Pay/Plate"]


def test_a_usd_mesh_goes_through_the_one_reader(tmp_path):
    asset = read_mesh(painted(tmp_path))
    assert asset.source.kind == "usd" and set(asset.mesh.parts) == {"red", "painted"}
    assert asset.source.uv == "kept"
    with pytest.raises(InputRefused, match="faces"):
        read_mesh(tmp_path / "a.usda", max_faces=2)


def test_what_we_wrote_comes_back(tmp_path):
    from mistyle.deliver.asset import write_asset
    from mistyle.deliver.export import DeliveryRequest, export

    occlusion = np.ones((16, 16), np.float32)
    write_asset(
        tmp_path / "asset", "ball", bumpy_sphere(), [quarters()] * 2, [occlusion] * 2, [no_texels()] * 2, provenance={}
    )
    export(tmp_path, tmp_path / "out", DeliveryRequest(formats=["usd"], target="blender"))
    for ending in ("usda", "usdz"):
        found = read_mesh(tmp_path / "out" / f"ball.{ending}", uv="keep")
        glb = read_mesh(tmp_path / "asset" / "ball.glb", uv="keep")
        assert len(found.mesh.faces) == len(glb.mesh.faces)
        for ours, theirs in zip(found.materials, glb.materials, strict=True):
            np.testing.assert_allclose(ours.albedo, theirs.albedo, atol=1e-6)
            np.testing.assert_allclose(ours.normal, theirs.normal, atol=1e-2)
            np.testing.assert_allclose(ours.roughness, theirs.roughness, atol=1 / 255)


ESCAPES = {
    "reference": ('def "R" ( references = @../secret.usda@ ) {}', "inside the mesh's own folder"),
    "absolute": ('def "R" ( references = @/etc/secret.usda@ ) {}', "inside the mesh's own folder"),
    "payload": ('def "R" ( payload = @../secret.usda@ ) {}', "inside the mesh's own folder"),
    "network": ('def "R" ( references = @https://example.org/a.usda@ ) {}', "nothing is fetched"),
    "variant": (
        'def "R" ( variants = { string v = "a" }\n prepend variantSets = "v" ) {\n variantSet "v" = {\n "a" {}\n'
        ' "b" ( references = @../secret.usda@ ) {}\n }\n }',
        "inside the mesh's own folder",
    ),
    "expression": ('def "R" ( references = @`"../secret.usda"`@ ) {}', "nothing is fetched"),
    "format": ('def "R" ( references = @./mesh.abc@ ) {}', "layers of kind"),
    "missing": ('def "R" ( references = @./gone.usda@ ) {}', "no file at"),
    "cycle": ('def "R" ( references = </Root> ) {}', "does not compose"),
    "clips": (
        'def "R" ( clips = { dictionary default = {\n asset[] assetPaths = [@../c.usda@]\n'
        ' string primPath = "/X"\n } }\n ) {}',
        "value clips",
    ),
}


@pytest.mark.parametrize("case", sorted(ESCAPES))
def test_nothing_outside_the_folder_is_opened(tmp_path, case):
    stage(tmp_path / "secret.usda", mesh())
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "mesh.abc").write_text("x")
    body, words = ESCAPES[case]
    with pytest.raises(InputRefused, match=words):
        raw(stage(tmp_path / "in" / "a.usda", mesh() + body))


def test_sublayers_and_links_out_of_the_folder(tmp_path):
    stage(tmp_path / "secret.usda", mesh())
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "link.usda").symlink_to(tmp_path / "secret.usda")
    for name in ("../secret.usda", "./link.usda"):
        with pytest.raises(InputRefused, match="inside the mesh's own folder"):
            raw(stage(tmp_path / "in" / "a.usda", mesh(), more=f"    subLayers = [@{name}@]\n"))
    # A texture out there is left out, with a note.
    text = painted(tmp_path / "in").read_text().replace("@./colour.png@", "@../colour.png@")
    (tmp_path / "in" / "a.usda").write_text(text)
    _, notes = next(m for m in raw(tmp_path / "in" / "a.usda").materials if m.name == "painted").load(1001)
    assert len(notes) == 2 and all("inside the mesh's own folder" in note for note in notes)


def test_nested_instances_and_broken_packages_are_refused(tmp_path):
    levels = 'class "L0" {' + mesh("M") + "}\n"
    for k in range(1, 14):
        inner = "".join(f'def "i{j}" ( instanceable = true\n references = </L{k - 1}> ) {{}}\n' for j in range(4))
        levels += f'class "L{k}" {{\n{inner}}}\n'
    path = stage(tmp_path / "bomb.usda", 'def "Top" ( instanceable = true\n references = </L13> ) {}')
    path.write_text(path.read_text() + levels)
    with pytest.raises(InputRefused, match="faces; expected at most"):
        raw(path, 1_000)
    good = stage(tmp_path / "a.usda", mesh())
    with zipfile.ZipFile(tmp_path / "packed.usdz", "w", zipfile.ZIP_DEFLATED) as package:
        package.write(good, "a.usda")
    with pytest.raises(InputRefused, match="compressed"):
        raw(tmp_path / "packed.usdz")
    with zipfile.ZipFile(tmp_path / "out.usdz", "w") as package:
        package.writestr("../a.usda", good.read_text())
    with pytest.raises(InputRefused, match="names inside the package"):
        raw(tmp_path / "out.usdz")
    (tmp_path / "no.usdz").write_bytes(b"PK\x03\x04 nothing")
    with pytest.raises(InputRefused, match="no package"):
        raw(tmp_path / "no.usdz")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("#usda 1.0\nrubbish", "USD cannot read"),
        ("", "USD"),
        (HEAD.format(axis="Y", unit=1, more="") + 'def Xform "Root" {}', "no mesh on its stage"),
    ],
)
def test_damaged_and_empty_stages(tmp_path, text, words):
    (tmp_path / "a.usda").write_text(text)
    with pytest.raises(InputRefused, match=words):
        raw(tmp_path / "a.usda")


def test_indices_and_numbers_are_checked(tmp_path):
    with pytest.raises(InputRefused, match="vertex 9"):
        raw(stage(tmp_path / "a.usda", mesh(indices="0, 1, 2, 9, 3, 2, 4")))
    with pytest.raises(InputRefused, match="as many indices"):
        raw(stage(tmp_path / "b.usda", mesh(indices="0, 1, 2")))
    path = stage(tmp_path / "c.usda", mesh())
    path.write_text(path.read_text().replace("(0.5, 2, 0)", "(nan, 2, 0)"))
    with pytest.raises(InputRefused, match="not finite"):
        raw(path)
    short = INDEXED.replace("0, 1, 2, 3, 3, 2, 4", "0, 1, 2")
    found = raw(stage(tmp_path / "d.usda", mesh(extra=short)))
    assert found.uvs is None and any("UVs were left out" in note for note in found.notes)


def test_without_the_library_the_sentence_says_what_to_install(tmp_path, monkeypatch):
    from mistyle.core.errors import EnvironmentMissing
    from mistyle.io.usd import write as usd

    def missing(name):
        raise ImportError(name)

    monkeypatch.setattr(usd, "import_module", missing)
    with pytest.raises(EnvironmentMissing, match=r"pip install 'mistyle\[usd\]'"):
        raw(stage(tmp_path / "a.usda", mesh()))


def test_a_change_in_a_layer_or_a_texture_is_noticed(tmp_path):
    from mistyle.jobs.inputs import input_files

    stage(tmp_path / "part.usda", mesh())
    path = painted(tmp_path)
    path.write_text(path.read_text() + 'def "More" ( references = @./part.usda@ ) {}\n')
    assert [p.name for p in input_files(path)] == ["a.usda", "colour.png", "normal.png", "part.usda"]


def run_of(folder: Path, source: Path, style: str, uv="keep") -> Path:
    """What a run over a USD mesh leaves: the asset, and the mesh as it was read."""
    from mistyle.deliver.asset import write_asset
    from mistyle.io.store.records import save_record

    asset = read_mesh(source, uv=uv)
    parts, occlusion = len(asset.mesh.parts), np.ones((16, 16), np.float32)
    told = {"mesh": source.name, "style": f"{style}.jpg"}
    write_asset(
        folder / "asset", f"{source.stem}_{style}", asset, [quarters()] * parts, [occlusion] * parts,
        [no_texels()] * parts, provenance=told,
    )  # fmt: skip
    save_record(folder / "work" / "mesh" / "record", asset)
    return folder


def opened(layer: Path, variant: str):
    from pxr import Usd

    found = Usd.Stage.Open(str(layer))
    sets = found.GetDefaultPrim().GetVariantSets()
    assert sets.HasVariantSet("look")
    sets.SetSelection("look", variant)
    return found


def test_a_look_layer_holds_a_variant_per_style_over_the_untouched_source(tmp_path):
    from pxr import UsdGeom, UsdShade

    from mistyle.deliver.export import DeliveryRequest, export
    from mistyle.io.usd.write import complaints

    source = painted(tmp_path)
    before = source.read_bytes()
    files = export(
        run_of(tmp_path / "one", source, "wave"), tmp_path / "out", DeliveryRequest(formats=["usd"], target="blender")
    )
    layer = tmp_path / "out" / "a_look.usda"
    assert layer in files and not list((tmp_path / "out").glob("*.usdz"))
    export(
        run_of(tmp_path / "two", source, "night"), tmp_path / "out", DeliveryRequest(formats=["usd"], target="houdini")
    )
    assert source.read_bytes() == before and complaints(layer) == []
    assert list(opened(layer, "wave").GetRootLayer().subLayerPaths) == ["../a.usda"]
    for variant, ending in (("wave", "png"), ("night", "exr")):
        found = opened(layer, variant)
        mesh_prim = found.GetPrimAtPath("/Root/Plate")
        subsets = UsdShade.MaterialBindingAPI(mesh_prim).GetMaterialBindSubsets()
        # The source's own subset and the mesh are bound: no subset is switched off, none is added.
        assert [(s.GetPrim().GetName(), len(s.GetIndicesAttr().Get())) for s in subsets] == [("top", 1)]
        bound = [UsdShade.MaterialBindingAPI(p).ComputeBoundMaterial()[0] for p in (mesh_prim, subsets[0].GetPrim())]
        assert bound[0].GetPath() != bound[1].GetPath()
        for material in bound:
            assert str(material.GetPath()).startswith("/Root/look/")
            texture = found.GetPrimAtPath(f"{material.GetPath()}/diffuseColor").GetAttribute("inputs:file").Get()
            assert texture.resolvedPath.endswith(f".{ending}") and Path(texture.resolvedPath).is_file()
            assert variant in texture.resolvedPath
        # The file's own UVs were kept: none are added.
        names = [p.GetPrimvarName() for p in UsdGeom.PrimvarsAPI(mesh_prim).GetPrimvars()]
        assert "st" in names and not any(n.startswith("st_") for n in names)
    # Read with our own reader, as a whole, where everything lies in one folder.
    (tmp_path / "out" / "a.usda").write_bytes(before)
    text = layer.read_text().replace("@../a.usda@", "@./a.usda@")
    (tmp_path / "out" / "all.usda").write_text(text)
    again = read_mesh(tmp_path / "out" / "all.usda", uv="keep")
    assert {m.albedo.shape for m in again.materials} == {(16, 16, 3)}


@pytest.mark.parametrize("orientation", ["rightHanded", "leftHanded"])
def test_new_uvs_come_as_a_primvar_and_may_cut_polygons(tmp_path, orientation):
    from pxr import UsdGeom

    from mistyle.deliver.export import DeliveryRequest, export
    from mistyle.io.usd.look import write_look
    from mistyle.io.usd.write import complaints

    extra = '    float3 xformOp:scale = (-1, 1, 1)\n    uniform token[] xformOpOrder = ["xformOp:scale"]\n'
    extra += '    normal3f[] normals = [(0, 0, 1), (0, 0, 1)] ( interpolation = "uniform" )\n'
    source = stage(tmp_path / "b.usda", mesh(orientation=orientation, extra=extra))
    run_of(tmp_path / "run", source, "wave", uv="auto")
    export(tmp_path / "run", tmp_path / "out", DeliveryRequest(formats=["usd"]))
    layer = tmp_path / "out" / "b_look.usda"
    asset = read_mesh(source)
    assert complaints(layer) == [] and asset.source.uv == "new"

    def check(asset, layer, faces):
        there = opened(layer, "wave")
        counts = UsdGeom.Mesh(there.GetPrimAtPath("/Root/Plate")).GetFaceVertexCountsAttr().Get()
        assert len(counts) == faces
        copy = tmp_path / "copy.usda"
        copy.write_text(layer.read_text().replace("@../b.usda@", "@./b.usda@").replace("./textures", "./out/textures"))
        found = raw(copy)
        order = np.lexsort(found.positions[found.faces].mean(axis=1).T)
        ours = np.lexsort(asset.source.user_positions[asset.mesh.faces].mean(axis=1).T)
        for k, j in zip(order, ours, strict=True):
            turn = next(
                t for t in range(3)
                if np.allclose(np.roll(found.positions[found.faces[k]], t, 0),
                               asset.source.user_positions[asset.mesh.faces[j]])
            )  # fmt: skip
            np.testing.assert_allclose(np.roll(found.uvs[k], turn, 0), asset.mesh.corner_uvs[j], atol=1e-6)

    check(asset, layer, 3 if _cut(asset) else 2)
    # UVs that differ across the quad's diagonal.
    import dataclasses

    torn = asset.mesh.corner_uvs.copy()
    torn[1] += 0.25
    asset = dataclasses.replace(asset, mesh=dataclasses.replace(asset.mesh, corner_uvs=torn))
    from mistyle.io.materialx import TexturedMaterial

    looks = [
        TexturedMaterial(
            "material", *(f"textures/b_wave_{m}.png" for m in ("albedo", "normal", "roughness", "metallic"))
        )
    ]
    write_look(tmp_path / "out" / "torn.usda", None, asset, looks, "wave", beside=tmp_path / "out")
    assert complaints(tmp_path / "out" / "torn.usda") == []
    check(asset, tmp_path / "out" / "torn.usda", 3)


def test_a_sphere_gets_no_look(tmp_path):
    """It has no faces that a layer could bind materials to, or give coordinates."""
    from mistyle.io.materialx import TexturedMaterial
    from mistyle.io.usd.look import write_look

    asset = read_mesh(stage(tmp_path / "a.usda", 'def Sphere "Ball" {}\n'), size=64)
    looks = [
        TexturedMaterial("material", *(f"textures/{m}.png" for m in ("albedo", "normal", "roughness", "metallic")))
    ]
    with pytest.raises(InputRefused, match="Ball is a Sphere"):
        write_look(tmp_path / "look.usda", None, asset, looks, "wave", beside=tmp_path)


def _cut(asset) -> bool:
    """Whether the new UVs part the quad along its diagonal."""
    corners = {}
    for face, uvs in zip(asset.mesh.faces[:2].tolist(), asset.mesh.corner_uvs[:2], strict=True):
        for vertex, uv in zip(face, uvs.tolist(), strict=True):
            corners.setdefault(vertex, set()).add(tuple(np.round(uv, 6)))
    return any(len(uvs) > 1 for uvs in corners.values())


def test_a_look_needs_the_source_and_the_run(tmp_path):
    import shutil

    from mistyle.core.errors import UsageError
    from mistyle.deliver.export import DeliveryRequest, export

    source = painted(tmp_path)
    run_of(tmp_path / "run", source, "wave")
    moved = tmp_path / "moved.usda"
    source.rename(moved)
    with pytest.raises(UsageError, match="--source"):
        export(tmp_path / "run", tmp_path / "out", DeliveryRequest(formats=["usd"]))
    export(tmp_path / "run", tmp_path / "out", DeliveryRequest(formats=["usd"], source=moved))
    moved.write_text(moved.read_text().replace("[4, 3]", "[4]").replace("0, 1, 2, 3, 3, 2, 4", "0, 1, 2, 3"))
    with pytest.raises(InputRefused, match="no longer the mesh"):
        export(tmp_path / "run", tmp_path / "other", DeliveryRequest(formats=["usd"], source=moved))
    shutil.rmtree(tmp_path / "run" / "work")
    with pytest.raises(InputRefused, match="whole run folder"):
        export(tmp_path / "run", tmp_path / "third", DeliveryRequest(formats=["usd"], source=moved))


def test_damaged_bytes_are_refused_or_read_and_never_more(tmp_path, rng):
    from pxr import Sdf, Usd, UsdUtils

    source = painted(tmp_path)
    Usd.Stage.Open(str(source)).Export(str(tmp_path / "b.usdc"))
    assert UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(source)), str(tmp_path / "c.usdz"))
    refused = 0
    for path in (source, tmp_path / "b.usdc", tmp_path / "c.usdz"):
        whole = path.read_bytes()
        for k in range(6):
            data = bytearray(whole[: rng.integers(len(whole))] if k == 0 else whole)
            for place in rng.integers(len(data), size=rng.integers(1, 12)):
                data[place] = rng.integers(256)
            damaged = tmp_path / f"damaged{path.suffix}"
            damaged.write_bytes(bytes(data))
            try:
                assert len(read_mesh(damaged).mesh.faces) == 3
            except InputRefused as error:
                assert str(damaged) in str(error)
                refused += 1
    assert refused >= 12


@pytest.mark.parametrize("points", ["int[] points = [0, 1, 2]", "point3f points = (0, 1, 2)", "double points = 7"])
def test_points_of_another_type_are_left_out_with_a_note(points: str, tmp_path: Path) -> None:
    other = mesh("Odd").replace("point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0.5, 2, 0)]", points)
    found = raw(stage(tmp_path / "a.usda", mesh() + other))
    assert len(found.faces) == 3
    assert any("points are of another type" in note for note in found.notes)


@pytest.mark.parametrize("normals", ["int normals = 7", "normal3f normals = (0, 0, 1)", "int[] normals = [1, 2, 3]"])
def test_normals_of_another_type_are_left_out_with_a_note(normals: str, tmp_path: Path) -> None:
    found = raw(stage(tmp_path / "a.usda", mesh(extra=INDEXED + normals)))
    assert found.normals is None
    assert any("Normals of another type" in note for note in found.notes)
