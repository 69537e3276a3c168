"""MaterialX documents that USD stages reference: what is read of them, and what a note tells."""

import sys
from pathlib import Path

import numpy as np
import pytest

from mistyle.core.asset import Asset
from mistyle.core.image import linear_from_srgb
from mistyle.io.read_mesh import read_mesh
from tests.support.named_files import RED, colour, files, picture, usd_materialx

pytest.importorskip("pxr")
pytest.importorskip("MaterialX")


def asset_of(folder: Path, nodes: str, surface: str, kind: str = "standard_surface", more: str = "") -> Asset:
    """A square with a surface of a document beside it."""
    mesh = usd_materialx(folder, "m.mtlx")
    (folder / "m.mtlx").write_text(
        f'<?xml version="1.0"?><materialx version="1.38" colorspace="lin_rec709"{more}>{nodes}'
        f'<{kind} name="s" type="surfaceshader">{surface}</{kind}><surfacematerial name="m" type="material">'
        '<input name="surfaceshader" type="surfaceshader" nodename="s"/></surfacematerial></materialx>'
    )
    return read_mesh(mesh)


def value(name: str, text: str, kind: str = "float", more: str = "") -> str:
    return f'<input name="{name}" type="{kind}" value="{text}"{more}/>'


def image(name: str, kind: str = "color3", category: str = "image", more: str = "") -> str:
    file = value("file", "red.png", "filename", ' colorspace="srgb_texture"')
    return f'<{category} name="{name}" type="{kind}">{file}{more}</{category}>'


def node(kind: str, name: str, inputs: str, of: str = "color3") -> str:
    return f'<{kind} name="{name}" type="{of}">{inputs}</{kind}>'


def link(name: str, to: str, kind: str = "color3", more: str = "") -> str:
    return f'<input name="{name}" type="{kind}" nodename="{to}"{more}/>'


NAMES = {
    "standard_surface": ("base_color", "specular_roughness", "metalness"),
    "open_pbr_surface": ("base_color", "specular_roughness", "base_metalness"),
    "gltf_pbr": ("base_color", "roughness", "metallic"),
    "UsdPreviewSurface": ("diffuseColor", "roughness", "metallic"),
}
DEFAULTS = {
    "standard_surface": (0.8, 0.2, 0.0),
    "open_pbr_surface": (0.8, 0.3, 0.0),
    "gltf_pbr": (1.0, 1.0, 1.0),
    "UsdPreviewSurface": (0.18, 0.5, 0.0),
}


@pytest.mark.parametrize("kind", sorted(NAMES))
def test_constants_of_every_surface_and_its_defaults(kind, tmp_path):
    albedo, roughness, metallic = NAMES[kind]
    values = value(albedo, "0.1, 0.2, 0.3", "color3") + value(roughness, "0.4") + value(metallic, "0.6")
    (material,) = asset_of(tmp_path, "", values, kind).materials
    np.testing.assert_allclose(material.albedo_factor, (0.1, 0.2, 0.3), atol=1e-6)
    np.testing.assert_allclose((material.roughness_factor, material.metallic_factor), (0.4, 0.6), atol=1e-6)
    (material,) = asset_of(tmp_path, "", "", kind).materials
    found = (material.albedo_factor[1], material.roughness_factor, material.metallic_factor)
    np.testing.assert_allclose(found, DEFAULTS[kind], atol=1e-6)


def test_weights_and_encoded_constants(tmp_path):
    encoded = value("base_color", "0.5, 0.25, 1", "color3", ' colorspace="srgb_texture"') + value("base", "0.5")
    (material,) = asset_of(tmp_path, "", encoded).materials
    expected = 0.5 * linear_from_srgb(np.array([0.5, 0.25, 1]))
    np.testing.assert_allclose(material.albedo_factor, expected, atol=1e-4)


GREY = (64, 128, 191)
CHAINS = {
    "an image": (image("i"), "i", lambda c: c),
    "a product": (
        image("i") + node("multiply", "n", link("in1", "i") + value("in2", "0.5, 1, 0.25", "color3")),
        "n",
        lambda c: c * [0.5, 1, 0.25],
    ),
    "inverted": (image("i") + node("invert", "n", link("in", "i")), "n", lambda c: 1 - c),
    "a sum of a quotient": (
        image("i")
        + node("divide", "d", link("in1", "i") + value("in2", "2"))
        + node("add", "n", link("in1", "d") + value("in2", "0.1")),
        "n",
        lambda c: c / 2 + 0.1,
    ),
    "a difference": (
        image("i") + node("subtract", "n", value("in1", "1, 1, 1", "color3") + link("in2", "i")),
        "n",
        lambda c: 1 - c,
    ),
    "a channel": (
        image("i")
        + node("extract", "e", link("in", "i") + value("index", "1", "integer"), "float")
        + node("convert", "n", link("in", "e", "float")),
        "n",
        lambda c: np.repeat(c[1], 3),
    ),
}


@pytest.mark.parametrize("case", sorted(CHAINS))
def test_chains_of_one_texture(case, tmp_path):
    nodes, last, expected = CHAINS[case]
    asset_of(tmp_path, nodes, link("base_color", last))
    picture(tmp_path / "red.png", GREY)
    asset = read_mesh(tmp_path / "box.usda")
    texel = expected(linear_from_srgb(np.array(GREY) / 255))
    assert asset.materials[0].albedo is not None, asset.source.notes
    np.testing.assert_allclose(asset.materials[0].albedo[0, 0], texel, atol=2 / 255)


def test_roughness_and_normals_are_data(tmp_path):
    nodes = image("r", "float") + image("i", "vector3")
    nodes += node("normalmap", "n", link("in", "i", "vector3") + value("scale", "0.5"), "vector3")
    graph = f'<nodegraph name="g">{nodes}<output name="a" type="float" nodename="r"/>'
    graph += '<output name="b" type="vector3" nodename="n"/></nodegraph>'
    ends = '<input name="{}" type="{}" nodegraph="g" output="{}"/>'
    surface = ends.format("specular_roughness", "float", "a") + ends.format("normal", "vector3", "b")
    asset_of(tmp_path, graph, surface)
    picture(tmp_path / "red.png", (128, 200, 240))
    material = read_mesh(tmp_path / "box.usda").materials[0]
    assert material.roughness is not None and material.normal is not None
    np.testing.assert_allclose(material.roughness[0, 0], 128 / 255, atol=1e-3)
    normal = (2 * np.array([128, 200, 240]) / 255 - 1) * [0.5, 0.5, 1]
    np.testing.assert_allclose(material.normal[0, 0], normal / np.linalg.norm(normal), atol=1e-2)


def test_tiles_and_other_coordinates(tmp_path):
    tiled = image("i", category="tiledimage", more=value("uvtiling", "2, 3", "vector2"))
    asset_of(tmp_path, tiled, link("base_color", "i"))
    from mistyle.io.usd.read import read_usd

    texture = next(iter(read_usd(tmp_path / "box.usda", 100).materials)).load(1001)[0]["albedo"]
    assert texture.transform is not None
    np.testing.assert_allclose(texture.transform, np.diag([2, 3, 1]))


UNREAD = {
    "a mix": (image("i") + node("mix", "n", link("fg", "i")), link("base_color", "n"), "has a node 'mix'"),
    "noise": (node("noise2d", "n", ""), link("base_color", "n"), "has a node 'noise2d'"),
    "two textures": (
        image("i") + image("j") + node("multiply", "n", link("in1", "i") + link("in2", "j")),
        link("base_color", "n"),
        "a product of two textures",
    ),
    "a circle": (node("dot", "n", link("in", "n")), link("base_color", "n"), "a graph of more than"),
    "nothing there": ("", '<input name="base_color" type="color3" nodename="gone"/>', "an absent node 'gone'"),
    "bare normals": (image("i", "vector3"), link("normal", "i", "vector3"), "without a normal map node"),
    "a coat": ("", value("coat", "1"), "The coat of MaterialX material 'm' was not read"),
    "another file": (
        image("i").replace("red.png", "../../red.png"),
        link("base_color", "i"),
        "expected a file inside the mesh's own folder",
    ),
}


@pytest.mark.parametrize("case", sorted(UNREAD))
def test_what_is_not_understood_is_a_note(case, tmp_path):
    nodes, surface, words = UNREAD[case]
    asset = asset_of(tmp_path, nodes, surface)
    assert any(words in note for note in asset.source.notes), asset.source.notes
    assert asset.materials[0].albedo is None and len(asset.mesh.faces) == 2


def test_a_broken_or_absent_document_leaves_the_mesh(tmp_path, monkeypatch):
    mesh = usd_materialx(tmp_path, "m.mtlx")
    assert colour(mesh) == list(RED)
    (tmp_path / "m.mtlx").write_text("<materialx")
    asset = read_mesh(mesh)
    assert any("m.mtlx was left out with its materials" in note for note in asset.source.notes)
    assert len(asset.mesh.faces) == 2 and asset.materials[0].albedo is None
    (tmp_path / "m.mtlx").unlink()
    asset = read_mesh(mesh)
    assert any("m.mtlx is not there; its materials were left out" in note for note in asset.source.notes)
    assert len(asset.mesh.faces) == 2
    # Without the package the mesh is read, too; this process decodes here.
    from mistyle.io.usd.read import read_usd

    usd_materialx(tmp_path, "m.mtlx")
    monkeypatch.setitem(sys.modules, "MaterialX", None)
    assert any("it needs MaterialX" in note for note in read_usd(mesh, 100).notes)


def test_documents_open_no_other_files(tmp_path):
    (tmp_path / "in").mkdir()
    mesh = usd_materialx(tmp_path / "in", "m.mtlx")
    secret = tmp_path / "secret.mtlx"
    (tmp_path / "in" / "m.mtlx").rename(secret)
    (tmp_path / "in" / "m.mtlx").write_text(
        '<?xml version="1.0"?><materialx version="1.38" xmlns:xi="http://www.w3.org/2001/XInclude">'
        f'<xi:include href="{secret}"/></materialx>'
    )
    asset = read_mesh(mesh)
    assert asset.materials[0].albedo is None
    assert any("includes other documents, which were not read" in note for note in asset.source.notes)
    assert secret not in files(mesh)


def test_the_document_and_its_textures_are_hashed_and_the_layer_stays(tmp_path):
    mesh = usd_materialx(tmp_path, "m.mtlx")
    before = mesh.read_bytes()
    assert {tmp_path / "m.mtlx", tmp_path / "red.png"} <= set(files(mesh))
    assert colour(mesh) == list(RED) and mesh.read_bytes() == before
    assert colour(mesh) == list(RED)  # a second time in the same process


def test_a_reference_to_what_a_document_lacks_is_tolerated_and_others_are_not(tmp_path):
    mesh = usd_materialx(tmp_path, "m.mtlx")
    text = mesh.read_text() + "\n"
    mesh.write_text(text + 'def "G" ( references = @m.mtlx@</MaterialX/Looks/a> ) {}\n')
    assert colour(mesh) == list(RED)
    (tmp_path / "other.usda").write_text("#usda 1.0\n")
    mesh.write_text(text + 'def "G" ( references = @other.usda@</Gone> ) {}\n')
    from mistyle.core.errors import InputRefused

    with pytest.raises(InputRefused, match="does not compose"):
        read_mesh(mesh)


def test_a_document_in_a_package(tmp_path):
    import zipfile

    mesh = usd_materialx(tmp_path, "m.mtlx")
    package = tmp_path / "pack" / "a.usdz"
    package.parent.mkdir()
    with zipfile.ZipFile(package, "w", zipfile.ZIP_STORED) as archive:
        for name in (mesh.name, "m.mtlx", "red.png"):
            data = (tmp_path / name).read_bytes()
            entry = zipfile.ZipInfo(name)
            offset = archive.start_dir + 30 + len(name)
            entry.extra = b"\x00" * (-offset % 64) if -offset % 64 >= 4 else b""
            archive.writestr(entry, data)
    assert colour(package) == list(RED)
