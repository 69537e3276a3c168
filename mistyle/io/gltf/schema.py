"""Schema of glTF's JSON for reading and patching, with types and ranges (glTF 2.0, chapter 5)."""

from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from mistyle.io.sandbox.bounds import MAX_FILE_BYTES, MAX_NODES

MAX_ELEMENTS = 100_000_000  # of one accessor


class JsonObject(BaseModel):
    model_config = ConfigDict(extra="allow", strict=True)


Index = Field(ge=0, le=2**31)


class JsonSparse(JsonObject):
    class Indices(JsonObject):
        bufferView: int = Index
        byteOffset: int = Field(0, ge=0)
        componentType: int

    class Values(JsonObject):
        bufferView: int = Index
        byteOffset: int = Field(0, ge=0)

    count: int = Field(ge=1, le=MAX_ELEMENTS)
    indices: Indices
    values: Values


class JsonAccessor(JsonObject):
    bufferView: int | None = Field(None, ge=0)
    byteOffset: int = Field(0, ge=0)
    componentType: int
    count: int = Field(ge=1, le=MAX_ELEMENTS)
    type: str
    normalized: bool = False
    sparse: JsonSparse | None = None


class JsonBufferView(JsonObject):
    buffer: int = Index
    byteOffset: int = Field(0, ge=0)
    byteLength: int = Field(ge=1)
    byteStride: int | None = Field(None, ge=1, le=252)


class JsonBuffer(JsonObject):
    byteLength: int = Field(ge=1, le=MAX_FILE_BYTES)
    uri: str | None = None


class JsonPrimitive(JsonObject):
    attributes: dict[str, int]
    indices: int | None = Field(None, ge=0)
    material: int | None = Field(None, ge=0)
    mode: int = Field(4, ge=0, le=6)
    targets: list[dict[str, int]] = []
    extensions: dict[str, Any] = {}


class JsonMesh(JsonObject):
    primitives: list[JsonPrimitive]
    name: str | None = None


class JsonNode(JsonObject):
    children: list[int] = []
    mesh: int | None = Field(None, ge=0)
    skin: int | None = Field(None, ge=0)
    matrix: list[float] | None = Field(None, min_length=16, max_length=16)
    translation: list[float] | None = Field(None, min_length=3, max_length=3)
    rotation: list[float] | None = Field(None, min_length=4, max_length=4)
    scale: list[float] | None = Field(None, min_length=3, max_length=3)
    extensions: dict[str, Any] = {}
    name: str | None = None


class JsonSkin(JsonObject):
    joints: list[int] = Field(min_length=1)
    inverseBindMatrices: int | None = Field(None, ge=0)


class JsonScene(JsonObject):
    nodes: list[int] = []


class JsonTextureInfo(JsonObject):
    index: int = Index
    texCoord: int = Field(0, ge=0, le=64)
    scale: float = 1.0
    extensions: dict[str, Any] = {}


class JsonMetallicRoughness(JsonObject):
    baseColorFactor: list[float] = Field([1.0, 1.0, 1.0, 1.0], min_length=4, max_length=4)
    baseColorTexture: JsonTextureInfo | None = None
    metallicFactor: float = 1.0
    roughnessFactor: float = 1.0
    metallicRoughnessTexture: JsonTextureInfo | None = None


class JsonMaterial(JsonObject):
    name: str | None = None
    pbrMetallicRoughness: JsonMetallicRoughness | None = None
    normalTexture: JsonTextureInfo | None = None
    emissiveTexture: JsonTextureInfo | None = None
    emissiveFactor: list[float] = Field([0.0, 0.0, 0.0], min_length=3, max_length=3)
    extensions: dict[str, Any] = {}


class JsonSampler(JsonObject):
    wrapS: int = 10497
    wrapT: int = 10497


class JsonTexture(JsonObject):
    sampler: int | None = Field(None, ge=0)
    source: int | None = Field(None, ge=0)
    extensions: dict[str, Any] = {}


class JsonImage(JsonObject):
    uri: str | None = None
    bufferView: int | None = Field(None, ge=0)
    mimeType: str | None = None


class JsonAsset(JsonObject):
    version: str


class Document(JsonObject):
    """The whole JSON document."""

    asset: JsonAsset
    accessors: list[JsonAccessor] = []
    bufferViews: list[JsonBufferView] = []
    buffers: list[JsonBuffer] = []
    meshes: list[JsonMesh] = []
    nodes: list[JsonNode] = Field([], max_length=MAX_NODES)
    skins: list[JsonSkin] = []
    scenes: list[JsonScene] = []
    scene: int | None = Field(None, ge=0)
    materials: list[JsonMaterial] = []
    textures: list[JsonTexture] = []
    images: list[JsonImage] = []
    samplers: list[JsonSampler] = []
    extensionsUsed: list[str] = []
    extensionsRequired: list[str] = []
