"""Settings of any kind of job, merged from layers: the root record has one record per stage, and presets.

Precedence, lowest first: defaults, preset, `--config FILE`, the environment (MISTYLE_VGG, OCIO, MISTYLE_SET), the
command line.
"""

import difflib
import os
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from mistyle.core.errors import InputRefused, UsageError
from mistyle.process.cores import cores

# Settings and tables of settings: earlier name -> present name.
RENAMED = {"surface.style_scale": "surface.stroke_scale", "coat": "paint"}

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
    """Settings from nested values. UsageError names the nearest key for an unknown one, and the path of a bad value."""
    try:
        return root.model_validate(dict(values))
    except ValidationError as error:
        first = error.errors()[0]
        path = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            if path in RENAMED:
                inner = first["input"]
                below = f".{next(iter(inner))}" if isinstance(inner, Mapping) and inner else ""
                raise UsageError(
                    f"{origin}: '{path}{below}' is now called '{RENAMED[path]}{below}'; write that"
                ) from None
            near = difflib.get_close_matches(path, known_keys(root), n=1, cutoff=0.5)
            hint = f"; did you mean '{near[0]}'?" if near else ""
            raise UsageError(f"{origin}: there is no setting '{path}'{hint} (--print-config lists all)") from None
        message = first["msg"].lower().removeprefix("value error, ")
        raise UsageError(f"{origin}: {path} = {first['input']!r}: {message}") from None


def read_config(path: Path) -> dict[str, Any]:
    """A job file in TOML; its keys are those that `--print-config` prints."""
    from mistyle.io.read import read_toml

    if not path.is_file():
        raise UsageError(f"{path}: no such file; --config takes a TOML file")
    try:
        return read_toml(path)
    except InputRefused as error:
        raise UsageError(f"{path}: not a TOML file of settings: {error}") from None


def resolve(
    preset: str | None,
    config: Path | None,
    command_line: Mapping[str, Any],
    environment: Mapping[str, str] = os.environ,
    *,
    root: type[Root],
    presets: Mapping[str, Mapping[str, Any]],
) -> Root:
    """The settings of a job after every layer; each layer is validated alone, so that the message names its origin."""
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
