"""All settings of a job in one place: the root record only lists one record per stage, and the presets.

Other kinds of job have a root record of their own (run/material_settings.py) and are resolved by the same functions.

Precedence, lowest first: defaults, preset, `--config FILE`, the environment (MISTYLE_VGG, OCIO, MISTYLE_SET), the
command line.
"""

import difflib
import os
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from mistyle.backends.diffusion_settings import DiffusionSettings, ModelSettings, Paint3dSettings, TrainSettings
from mistyle.core.camera import RigSettings
from mistyle.core.cores import cores
from mistyle.core.errors import InputRefused, UsageError
from mistyle.run.deliver_settings import ColourSettings, DeliverSettings
from mistyle.stages.backproject import BakeSettings
from mistyle.stages.finish_settings import FinishSettings
from mistyle.stages.fit import FitSettings
from mistyle.stages.inpaint import RepairSettings
from mistyle.stages.mvst import SweepSettings
from mistyle.stages.texels import AtlasSettings
from mistyle.surface.settings import CoatSettings, SurfaceSettings

READ_SAMPLES = 8  # per pixel of a view that a stylizer reads


class ReadSettings(BaseModel):
    """How the mesh is read."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    uv: Literal["keep", "new", "auto"] = Field(
        default="auto", description="authored UVs: keep, replace, or replace where unusable"
    )
    up: Literal["y", "z"] = Field(default="y", description="the axis of the user's file that points up")
    max_faces: int = Field(default=5_000_000, ge=1, description="meshes with more faces are refused")
    lit: bool = Field(default=False, description="unlit glTF materials become lit ones in the asset")


class DrawSettings(BaseModel):
    """How the views of the mesh are rendered (paper 4.1.1)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    spp: int = Field(
        default=0,
        ge=0,
        le=65536,
        description="samples per pixel of the rendered views; 0: 8 where a stylizer reads their colours, else 1",
    )
    scene: Path | None = Field(
        default=None, description="a Mitsuba scene with a shape called 'object' in place of scenes/paper_views.xml"
    )
    paper_files: bool = Field(default=False, description="also write the 8-bit depth maps and Canny edges of the paper")

    def samples(self, read: bool = True) -> int:
        """Samples per pixel of views whose colours are `read` by what comes next, or are for people only."""
        return self.spp or (READ_SAMPLES if read else 1)


class ReportSettings(BaseModel):
    """The pictures of the report."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    detail: Literal["none", "page", "full"] = Field(
        default="full",
        description="full also writes the turntable's frames and a path-traced picture; page only the page and its "
        "overview; none nothing",
    )
    frames: int = Field(default=24, ge=4, le=240, description="turntable frames")
    resolution: int = Field(default=448, ge=64, le=4096, description="pixels of a turntable frame")
    spp: int = Field(default=8, ge=1, le=4096, description="samples per pixel of a turntable frame")


class Settings(BaseModel):
    """One job: a mesh, a style, and how."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    seed: int = Field(default=0, ge=0, lt=2**31, description="every random choice follows from it")
    threads: int = Field(
        default=0, ge=0, le=1024, description="threads of the renderer and of torch; 0 takes all cores"
    )
    memory: float = Field(
        default=0,
        ge=0,
        le=100_000,
        description="GB of main memory that the job may take (then large arrays lie in files of its work folder where "
        "they must, with the same result; a job that cannot keep it is refused); 0: nine tenths of what there is",
    )
    variant: Literal["auto", "llvm_ad_rgb", "cuda_ad_rgb", "metal_ad_rgb"] = "auto"
    stylizer: Literal["embedded", "embedded-view", "diffusion"] = Field(
        default="embedded",
        description="embedded paints the surface once; embedded-view paints view after view from earlier ones; "
        "diffusion does the same with SDXL (needs models)",
    )
    inpainter: Literal["fill", "paint3d"] = Field(
        default="fill", description="fill takes the painting again; paint3d is Stable Diffusion (needs models)"
    )
    read: ReadSettings = ReadSettings()
    rig: RigSettings = RigSettings()
    draw: DrawSettings = DrawSettings()
    surface: SurfaceSettings = SurfaceSettings()
    coat: CoatSettings = CoatSettings()
    sweep: SweepSettings = SweepSettings()
    atlas: AtlasSettings = AtlasSettings()
    bake: BakeSettings = BakeSettings()
    finish: FinishSettings = FinishSettings()
    fit: FitSettings = FitSettings()
    repair: RepairSettings = RepairSettings()
    report: ReportSettings = ReportSettings()
    deliver: DeliverSettings = DeliverSettings()
    colour: ColourSettings = ColourSettings()
    models: ModelSettings = ModelSettings()
    train: TrainSettings = TrainSettings()
    diffusion: DiffusionSettings = DiffusionSettings()
    paint3d: Paint3dSettings = Paint3dSettings()

    @property
    def refined(self) -> Literal["off", "normal-roughness", "albedo", "all"]:
        """Which maps the fit may change. Where the surface is painted once, `fit.refine_painted` says so, unless other
        settings ask for the fit: its metallic, its own features, an inpainter."""
        if self.fit.refine != "auto":
            return self.fit.refine
        features = self.fit.features is not None and self.finish.method == "off"
        wanted = self.fit.metallic == "fit" or features or self.inpainter != "fill"
        return "all" if wanted or self.stylizer != "embedded" else self.fit.refine_painted

    @property
    def keeps_painting(self) -> bool:
        """Whether nothing after the bake changes the maps: the fit is off, and a repair would take the painting
        again."""
        return self.refined == "off" and self.stylizer == "embedded" and self.inpainter == "fill"


# The ways to run a job; the defaults of the records are the standard ones.
PRESETS: dict[str, dict[str, Any]] = {
    "draft": {
        "rig": {"resolution": 512},
        "surface": {"samples": 80_000},
        "atlas": {"size": 1024},
        "finish": {"steps": 20, "crops": 2},
        "fit": {"refine_painted": "off", "iterations1": 40, "iterations2": 40, "crops": 2, "crop_size": 192},
        "report": {"frames": 12, "resolution": 320, "spp": 4},
    },
    "standard": {},
    "fine": {
        "draw": {"paper_files": True},
        "surface": {"samples": 1_000_000},
        "atlas": {"size": 4096},
        "fit": {"refine": "all", "iterations1": 400, "iterations2": 600, "crops": 8, "lights": "together"},
        "diffusion": {"content": "per-view"},
    },
    # To the letter, also where mistyle/stylization/README.md lists departures. The paper gives no step counts;
    # these are those of `fine`.
    "paper": {
        "stylizer": "diffusion",
        "inpainter": "paint3d",
        "draw": {"paper_files": True},
        "sweep": {
            "order": "paper",
            "histogram": 1.0,
            "segmenter": "birefnet",
            "follow_outline": False,
            "warp": {"look_up": False, "facing": 0.0, "sharpness": 0.0},
        },
        "atlas": {"size": 4096},
        "fit": {
            "refine": "all",
            "painted": "with-light",
            "unlight": 0.0,
            "solve": False,
            "lights": "together",
            "features": "vgg19",
            "bridge": "wrap",
            "iterations1": 400,
            "iterations2": 600,
            "crops": 8,
            "tv_from": "style",
            "judge": False,
        },
        "repair": {"agreement": 1.0, "outlier": 0.0},
        "train": {"loss_mode": "sum"},
        "diffusion": {"content": "per-view"},
    },
}
# The demo has three minutes: the draft with finer strokes and a larger texture.
PRESETS["demo"] = PRESETS["draft"] | {"surface": {"samples": 150_000}, "atlas": {"size": 2048}}


# Settings by their earlier names.
RENAMED = {"surface.style_scale": "surface.stroke_scale"}

Root = TypeVar("Root", bound=BaseModel)


def thread_count(settings: Any) -> int:
    """The threads a job uses: as set, else the cores that this process may run on."""
    if settings.threads:
        return settings.threads
    return cores()


def merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """`over` laid upon `base`, record by record."""
    result = dict(base)
    for key, value in over.items():
        inner = result.get(key)
        result[key] = merge(inner, value) if isinstance(value, Mapping) and isinstance(inner, Mapping) else value
    return result


def assignments(pairs: Iterable[str], origin: str) -> dict[str, Any]:
    """'fit.phase1=200' lines as a nested dict; values are TOML where they parse as TOML, else text."""
    result: dict[str, Any] = {}
    for pair in pairs:
        key, equals, text = pair.partition("=")
        if not equals or not key.strip():
            raise UsageError(f"{origin}: '{pair}' is not of the form KEY=VALUE, for example fit.iterations1=100")
        try:
            value: Any = tomllib.loads(f"value = {text.strip()}")["value"]
        except tomllib.TOMLDecodeError:
            value = text.strip()
        for name in reversed(key.strip().split(".")):
            value = {name: value}
        result = merge(result, value)
    return result


def known_keys(model: type[BaseModel], prefix: str = "") -> list[str]:
    """Every dotted setting, leaves only."""
    keys: list[str] = []
    for name, field in model.model_fields.items():
        inner = field.annotation
        if isinstance(inner, type) and issubclass(inner, BaseModel):
            keys += known_keys(inner, f"{prefix}{name}.")
        else:
            keys.append(prefix + name)
    return keys


def validate(values: Mapping[str, Any], origin: str, root: type[Root]) -> Root:
    """Settings from nested values; refuses an unknown key with the nearest known one, a wrong value with its path."""
    try:
        return root.model_validate(dict(values))
    except ValidationError as error:
        first = error.errors()[0]
        path = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            if path in RENAMED:
                raise UsageError(f"{origin}: '{path}' is now called '{RENAMED[path]}'; write that") from None
            near = difflib.get_close_matches(path, known_keys(root), n=1, cutoff=0.5)
            hint = f"; did you mean '{near[0]}'?" if near else ""
            raise UsageError(f"{origin}: there is no setting '{path}'{hint} (--print-config lists all)") from None
        said = first["msg"].lower().removeprefix("value error, ")
        raise UsageError(f"{origin}: {path} = {first['input']!r}: {said}") from None


def read_config(path: Path) -> dict[str, Any]:
    """A job file in TOML; its keys are those that `--print-config` prints."""
    from mistyle.files.read import read_toml

    if not path.is_file():
        raise UsageError(f"{path}: no such file; --config wants a TOML file")
    try:
        return read_toml(path)
    except InputRefused as error:
        raise UsageError(f"{path}: not a TOML file that settings can be read from: {error}") from None


def resolve(
    preset: str | None,
    config: Path | None,
    command_line: Mapping[str, Any],
    environment: Mapping[str, str] = os.environ,
    root: type[Root] = Settings,
    presets: Mapping[str, Mapping[str, Any]] = PRESETS,
) -> Root:
    """The settings of a job after every layer; each layer is checked alone so that the message names the guilty one."""
    layers: list[tuple[str, Mapping[str, Any]]] = []
    if config is not None:
        values = read_config(config)
        preset = preset or values.pop("preset", None)
        values.pop("preset", None)
        layers.append((str(config), values))
    preset = preset or "standard"
    if not isinstance(preset, str) or preset not in presets:
        origin = f"{config}: " if config is not None else ""
        raise UsageError(f"{origin}there is no preset {str(preset)[:80]!r}; choose one of {', '.join(presets)}")
    if environment.get("MISTYLE_VGG") and "fit" in root.model_fields:
        layers.append(("MISTYLE_VGG", {"fit": {"features": environment["MISTYLE_VGG"]}}))
    if environment.get("OCIO") and "colour" in root.model_fields:
        layers.append(("OCIO", {"colour": {"config": environment["OCIO"]}}))
    variable = environment.get("MISTYLE_SET", "")
    layers.append(("MISTYLE_SET", assignments(filter(None, map(str.strip, variable.split(";"))), "MISTYLE_SET")))
    layers.append(("command line", command_line))
    values: Mapping[str, Any] = presets[preset]
    for origin, layer in layers:
        values = merge(values, layer)
        validate(values, origin, root)
    return validate(values, "settings", root)


def as_toml(settings: BaseModel) -> str:
    """The settings as a TOML file that `--config` reads back."""
    lines: list[str] = []

    def table(values: Mapping[str, Any], prefix: str) -> None:
        leaves = {k: v for k, v in values.items() if not isinstance(v, dict) and v is not None}
        if prefix:
            lines.extend(["", f"[{prefix}]"])
        lines.extend(f"{key} = {_toml_value(value)}" for key, value in leaves.items())
        lines.extend(f"# {key} is not set" for key, value in values.items() if value is None)
        for key, value in values.items():
            if isinstance(value, dict):
                table(value, f"{prefix}.{key}" if prefix else key)

    table(settings.model_dump(mode="json"), "")
    return "\n".join(lines) + "\n"


def _toml_value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_toml_value(item) for item in value) + "]"
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return f'"{escaped}"'
    return repr(value)
