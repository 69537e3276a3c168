"""The parts of glTF's JSON that reading and patching rely on, with their types and ranges (glTF 2.0, chapter 5)."""

from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from mistyle.files.bounds import MAX_FILE_BYTES, MAX_NODES

MAX_ELEMENTS = 100_000_000  # of one accessor


class Part(BaseModel):
    model_config = ConfigDict(extra="allow", strict=True)


Index = Field(ge=0, le=2**31)


class Sparse(Part):
    class Indices(Part):
        bufferView: int = Index
        byteOffset: int = Field(0, ge=0)
        componentType: int

    class Values(Part):
        bufferView: int = Index
        byteOffset: int = Field(0, ge=0)

    count: int = Field(ge=1, le=MAX_ELEMENTS)
    indices: Indices
    values: Values


class Accessor(Part):
    bufferView: int | None = Field(None, ge=0)
    byteOffset: int = Field(0, ge=0)
    componentType: int
    count: int = Field(ge=1, le=MAX_ELEMENTS)
    type: str
    normalized: bool = False
    sparse: Sparse | None = None


class View(Part):
    buffer: int = Index
    byteOffset: int = Field(0, ge=0)
    byteLength: int = Field(ge=1)
    byteStride: int | None = Field(None, ge=1, le=252)


class Buffer(Part):
    byteLength: int = Field(ge=1, le=MAX_FILE_BYTES)
    uri: str | None = None


class Primitive(Part):
    attributes: dict[str, int]
    indices: int | None = Field(None, ge=0)
    material: int | None = Field(None, ge=0)
    mode: int = Field(4, ge=0, le=6)
    targets: list[dict[str, int]] = []
    extensions: dict[str, Any] = {}


class Mesh(Part):
    primitives: list[Primitive]
    name: str | None = None


class Node(Part):
    children: list[int] = []
    mesh: int | None = Field(None, ge=0)
    skin: int | None = Field(None, ge=0)
    matrix: list[float] | None = Field(None, min_length=16, max_length=16)
    translation: list[float] | None = Field(None, min_length=3, max_length=3)
    rotation: list[float] | None = Field(None, min_length=4, max_length=4)
    scale: list[float] | None = Field(None, min_length=3, max_length=3)
    extensions: dict[str, Any] = {}
    name: str | None = None


class Skin(Part):
    joints: list[int] = Field(min_length=1)
    inverseBindMatrices: int | None = Field(None, ge=0)


class Scene(Part):
    nodes: list[int] = []


class Info(Part):
    index: int = Index
    texCoord: int = Field(0, ge=0, le=64)
    scale: float = 1.0
    extensions: dict[str, Any] = {}


class Metallic(Part):
    baseColorFactor: list[float] = Field([1.0, 1.0, 1.0, 1.0], min_length=4, max_length=4)
    baseColorTexture: Info | None = None
    metallicFactor: float = 1.0
    roughnessFactor: float = 1.0
    metallicRoughnessTexture: Info | None = None


class Material(Part):
    name: str | None = None
    pbrMetallicRoughness: Metallic | None = None
    normalTexture: Info | None = None
    emissiveTexture: Info | None = None
    emissiveFactor: list[float] = Field([0.0, 0.0, 0.0], min_length=3, max_length=3)
    extensions: dict[str, Any] = {}


class Sampler(Part):
    wrapS: int = 10497
    wrapT: int = 10497


class Texture(Part):
    sampler: int | None = Field(None, ge=0)
    source: int | None = Field(None, ge=0)
    extensions: dict[str, Any] = {}


class Image(Part):
    uri: str | None = None
    bufferView: int | None = Field(None, ge=0)
    mimeType: str | None = None


class Asset(Part):
    version: str


class Document(Part):
    """The whole file."""

    asset: Asset
    accessors: list[Accessor] = []
    bufferViews: list[View] = []
    buffers: list[Buffer] = []
    meshes: list[Mesh] = []
    nodes: list[Node] = Field([], max_length=MAX_NODES)
    skins: list[Skin] = []
    scenes: list[Scene] = []
    scene: int | None = Field(None, ge=0)
    materials: list[Material] = []
    textures: list[Texture] = []
    images: list[Image] = []
    samplers: list[Sampler] = []
    extensionsUsed: list[str] = []
    extensionsRequired: list[str] = []
