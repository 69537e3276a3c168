"""Whether a parameter of a live Mitsuba scene affects pictures, and whether its integrator differentiates it.

Every rule is about a kind of parameter. Detached sampling (`prb`, `prbvolpath`) has no derivative of delta lobes:
mirrors, smooth glass, and transmission through a mask. Attached sampling (`direct`) has the derivative of their
colours, but none of the probability of choosing a lobe.
"""

import re
from collections.abc import Iterator, Mapping
from typing import Any

from mistyle.render.mitsuba.device import mi

Children = Mapping[Any, list[tuple[str, Any]]]

# Roles that determine the probabilities of lobes under attached sampling.
SHARES = {"opacity", "weight", "eta", "int_ior", "ext_ior"}


def below(node: Any, held: Children) -> Iterator[tuple[str, Any, Any]]:
    """(name, holder, plugin) of all descendants of a plugin, each plugin once per holder."""
    left, seen = [node], set()
    while left:
        holder = left.pop()
        if holder in seen:
            continue
        seen.add(holder)
        for name, child in held.get(holder, ()):
            yield name, holder, child
            left.append(child)


def drawn(scene: Any, held: Children) -> set[Any]:
    """The plugins that rendering reads: shapes, lights, cameras, integrators and their descendants."""
    kinds = (mi.Shape, mi.Emitter, mi.Sensor, mi.Integrator)
    roots = [child for _, child in held[scene] if isinstance(child, kinds)]
    return {scene, *roots, *(child for root in roots for _, _, child in below(root, held))}


def readers(shape: Any, attribute: str, held: Children) -> list[tuple[str, Any]] | None:
    """(role, owner) of the textures that read a mesh's attribute; None if a user's plugin may read it itself."""
    textures, own = [], False
    for name, holder, child in below(shape, held):
        if child.class_name() == "MeshAttribute" and re.search(rf'name = "{re.escape(attribute)}"', str(child)):
            textures.append((name, holder))
        own |= type(child).__module__.partition(".")[0] not in ("mitsuba", "drjit")
    return textures if textures or not own else None


def no_gradient(node: Any, owner: Any, role: str, engine: Any) -> str | None:
    """Why the integrator has no correct gradient of a parameter; None if it has. `engine` None: `prb`."""
    detached = engine is None or isinstance(engine, mi.ad.integrators.common.ADIntegrator)
    called = "prb" if engine is None else str(engine).partition("[")[0].removesuffix("Integrator").lower()
    inside = isinstance(owner, (mi.Medium, mi.PhaseFunction)) or isinstance(node, mi.Volume)
    if inside and engine is not None and "vol" not in called:
        return f"it belongs to a medium, and the integrator {called} does not support media."
    if not isinstance(owner, mi.BSDF) or not int(owner.flags()) & int(mi.BSDFFlags.Delta):
        return None
    if role == "diffuse_reflectance":
        return None  # `prb` adds some mirrored light to this gradient; the minimum stays
    kind = re.sub(r"(BSDF|BRDF)$", "", owner.class_name())
    if detached:
        return (
            f"{kind} has a delta lobe (of a mirror, smooth glass or a mask), for which the "
            f"integrator {called} has no correct gradient; a rough material in its place can be fitted."
        )
    if role in SHARES and "Conductor" not in kind:
        return f"it sets the probabilities of the lobes of {kind}, for which {called} has no correct gradient."
    return None
