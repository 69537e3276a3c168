"""OpenColorIO colour spaces for input and output; the pipeline works in linear Rec.709 (D65).

Needs the extra `ocio` (opencolorio) only where a space is named. The config is the requested one, else opencolorio's
default. An interchange role, which every ACES config has, connects it with the working space. EXR files are tagged with
the Color Interop Forum's identifier of the space, if any, and with that space's own chromaticities. The identifier
follows from the transform, not from the config's name of the space.
"""

import difflib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.core.errors import EnvironmentMissing, UsageError
from mistyle.io.images.write import LINEAR_REC709, REC709_CHROMATICITIES

DEFAULT = "ocio://default"
# Built into every opencolorio since 2.2, without a file or a network.
WORKING = ("ocio://cg-config-v1.0.0_aces-v1.3_ocio-v2.1", "lin_rec709")
# Interop identifier -> the space's name in that config; (x, y) of red, green, blue and white.
KNOWN = {
    "lin_ap1_scene": ("ACEScg", (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767)),
    "lin_ap0_scene": ("ACES2065-1", (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)),
    "lin_rec2020_scene": ("Linear Rec.2020", (0.708, 0.292, 0.17, 0.797, 0.131, 0.046, 0.3127, 0.329)),
    "lin_p3d65_scene": ("Linear P3-D65", (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.3127, 0.329)),
    LINEAR_REC709: ("lin_rec709", REC709_CHROMATICITIES),
}
Pixels = Float[np.ndarray, "*n 3"]


@dataclass(frozen=True)
class ColourSpace:
    """A space by its name in `config`: `to_working` takes its values to linear Rec.709, `from_working` back.

    interop  the Color Interop Forum's identifier, "" where it has no known one
    """

    name: str
    config: str
    interop: str
    to_working: Callable[[Pixels], Pixels]
    from_working: Callable[[Pixels], Pixels]


def library() -> Any:
    """PyOpenColorIO. Raises EnvironmentMissing where it is not installed."""
    try:
        import PyOpenColorIO
    except ImportError:
        raise EnvironmentMissing("--colorspace needs OpenColorIO: pip install 'mistyle[ocio]'") from None
    return PyOpenColorIO


def colour_space(name: str, config: str | None = None, *, linear: bool = True) -> ColourSpace:
    """The space `name` (or an alias or a role) of a config: a file, or ocio://…; None: opencolorio's own.

    With `linear` a space that is not scene-linear is refused, since EXR textures hold light. Raises UsageError with the
    nearest names, or EnvironmentMissing.
    """
    ocio = library()
    where = config or DEFAULT
    opened = _opened(where)
    space = opened.getColorSpace(name)
    if space is None:
        raise UsageError(f"--colorspace {name!r}: {where} has no such space; {_near(name, opened)}")
    if space.isData():
        raise UsageError(f"--colorspace {name!r}: it holds data, not colours; {_near('', opened)}")
    if linear and not opened.isColorSpaceLinear(space.getName(), space.getReferenceSpaceType()):
        raise UsageError(f"--colorspace {name!r}: it is not linear, and EXR textures hold light; {_near('', opened)}")
    try:
        to_working = _processor(ocio, opened, space.getName(), _opened(WORKING[0]), WORKING[1])
        from_working = _processor(ocio, _opened(WORKING[0]), WORKING[1], opened, space.getName())
    except ocio.Exception as error:
        message = str(error).split("\n")[0][:200]
        raise UsageError(
            f"--colorspace {name!r}: {where} does not relate its colours to other spaces ({message}); it needs the "
            "role aces_interchange, which the ACES configs have"
        ) from None
    return ColourSpace(space.getName(), where, _interop(to_working) if linear else "", to_working, from_working)


@cache
def _opened(where: str) -> Any:
    ocio = library()
    try:
        return ocio.Config.CreateFromFile(where)
    except (ocio.Exception, ocio.ExceptionMissingFile) as error:
        message = str(error).split("\n")[0][:200]
        raise UsageError(f"{where}: not an OpenColorIO config ({message}); check $OCIO or colour.config") from None


def _processor(ocio: Any, source: Any, name: str, target: Any, target_name: str) -> Callable[[Pixels], Pixels]:
    processor = ocio.Config.GetProcessorFromConfigs(source, name, target, target_name)
    exact = processor.getOptimizedCPUProcessor(ocio.OPTIMIZATION_LOSSLESS)

    def apply(rgb: Pixels) -> Pixels:
        flat = np.array(rgb, np.float32, order="C").reshape(-1, 3)
        exact.applyRGB(flat)
        return flat.reshape(rgb.shape)

    return apply


def _interop(to_working: Callable[[Pixels], Pixels]) -> str:
    """The identifier of the known space with the same transform of red, green and blue; "" without one."""
    ocio, basis = library(), np.eye(3, dtype=np.float32)
    own = to_working(basis)
    home = _opened(WORKING[0])
    for identifier, (name, _) in KNOWN.items():
        candidate = _processor(ocio, home, name, home, WORKING[1])(basis)
        if np.abs(own - candidate).max() < 1e-3:
            return identifier
    return ""


def _near(name: str, config: Any) -> str:
    """Suggested names: those similar to `name`, else the linear ones."""
    spaces = [config.getColorSpace(n) for n in config.getColorSpaceNames()]
    known = {alias.lower(): s.getName() for s in spaces for alias in [s.getName(), *s.getAliases()]}
    close = difflib.get_close_matches(name.lower(), list(known), n=6, cutoff=0.45) if name else []
    chosen = list(dict.fromkeys(known[c] for c in close))[:3]
    if chosen:
        return "did you mean " + " or ".join(f"'{c}'" for c in chosen) + "?"
    linear = [s.getName() for s in spaces if not s.isData()]
    linear = [n for n in linear if config.isColorSpaceLinear(n, config.getColorSpace(n).getReferenceSpaceType())]
    return "linear ones are " + ", ".join(f"'{n}'" for n in linear[:8])


def exr_tags(space: ColourSpace | None) -> dict[str, Any]:
    """Colour attributes of an EXR in this space (None: linear Rec.709). Without a standard identifier they are the
    space's own name and no chromaticities, which are unknown."""
    if space is None or space.interop == LINEAR_REC709:
        return {"colorInteropID": LINEAR_REC709, "chromaticities": REC709_CHROMATICITIES}
    if space.interop:
        return {"colorInteropID": space.interop, "chromaticities": KNOWN[space.interop][1]}
    return {"colorInteropID": "unknown", "mistyle:colorspace": space.name}


def materialx_space(space: ColourSpace | None) -> str:
    """The space's name in MaterialX and in OpenColorIO's aliases."""
    if space is None:
        return "lin_rec709"
    return space.interop.removesuffix("_scene") if space.interop else space.name
