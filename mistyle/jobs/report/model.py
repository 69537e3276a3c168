"""The 3D model in the report: its GLB with smaller textures, packed into the page, and the viewer.

The viewer is `vendor/model-viewer-umd.min.js` (vendor/NOTICE.txt names its source and licences). It reads the asset
from the page itself; the page's policy forbids every other request.
"""

import base64
import copy
import gzip
from dataclasses import dataclass
from pathlib import Path
from typing import Any

VENDOR = Path(__file__).parent / "vendor"
VIEWER = VENDOR / "model-viewer-umd.min.js"
VIEWER_SHA256 = "d785423b1d046ea84a9f59ef6cf15f3077603e1bf938b01ced9b0240691884a2"
# Bytes of the packed vertices and faces; larger assets are shown as pictures only.
MOST_GEOMETRY = 4_500_000


@dataclass(frozen=True)
class PageModel:
    """A glTF asset as `load_gltf` reads it, and the name of its file."""

    name: str
    tree: dict[str, Any]
    buffers: list[bytes]


@dataclass(frozen=True)
class TooLarge:
    """An asset that is too large for a page, and the sentence that the page shows instead."""

    sentence: str


def page_model(glb: Path) -> PageModel | TooLarge:
    """The asset for a page, or TooLarge if its packed vertices and faces exceed MOST_GEOMETRY bytes."""
    from mistyle.io.read_mesh import load_gltf

    tree, buffers = load_gltf(glb)
    model = PageModel(glb.name, tree, buffers)
    pictures = {image.get("bufferView") for image in tree.get("images", [])}
    geometry = sum(v["byteLength"] for k, v in enumerate(tree.get("bufferViews", [])) if k not in pictures)
    # Packing saves a third to a half, so geometry of four times the limit is too large in any case.
    size = geometry if geometry > 4 * MOST_GEOMETRY else len(packed(model, 16))
    if size <= MOST_GEOMETRY:
        return model
    return TooLarge(
        f"The vertices and faces of {glb.name} take {size / 1e6:.0f} MB, and this page keeps at most "
        f"{MOST_GEOMETRY / 1e6:.1f} MB for them: open the file itself in any glTF viewer."
    )


def packed(model: PageModel, longest: int) -> str:
    """The asset as base64 of gzip of a GLB whose textures are at most `longest` pixels wide and high.

    Textures become JPEG, those with transparency PNG. The same asset gives the same text.
    """
    from mistyle.io.gltf.glb import Builder
    from mistyle.io.read import shrink_picture

    builder = Builder(copy.deepcopy(model.tree), model.buffers)
    tree = builder.tree
    normals = {m["normalTexture"]["index"] for m in tree.get("materials", []) if "normalTexture" in m}
    exact = {tree["textures"][k].get("source") for k in normals}
    for k, image in enumerate(tree.get("images", [])):
        if "bufferView" in image:
            quality = 94 if k in exact else 86
            data, kind = shrink_picture(Path(model.name), builder.blobs[image["bufferView"]], longest, quality)
            builder.blobs[image["bufferView"]], image["mimeType"] = data, kind
    for texture in tree.get("textures", []):
        # Its decoder would need the network; a texture with this optional extension has a plain image as well.
        texture.get("extensions", {}).pop("KHR_texture_basisu", None)
    return base64.b64encode(gzip.compress(builder.pack(), 9, mtime=0)).decode()


# The page's policy forbids WebAssembly. The viewer needs it only for compressed geometry, and tests for it first.
WITHOUT_WASM = "globalThis.WebAssembly = undefined;\n"


def viewer_script() -> str:
    """The viewer's script without the line that names its source map, which a browser would request."""
    text = VIEWER.read_text(encoding="utf-8")
    return WITHOUT_WASM + text.partition("\n//# sourceMappingURL=")[0]
