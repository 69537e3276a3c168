"""Node graphs of MaterialX, as far as one texture or constant, scaled and shifted, stands for them."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

MAX_STEPS = 200  # of one graph; a graph may name itself
IMAGES = ("image", "tiledimage", "gltf_image", "gltf_colorimage", "UsdUVTexture")
FACTORS = {"gltf_image": ("factor",), "gltf_colorimage": ("color",), "UsdUVTexture": ("scale",)}
COORDINATES = {"texcoord": "", "geompropvalue": "geomprop", "UsdPrimvarReader": "varname"}
NORMAL_MAPS = ("normalmap", "gltf_normalmap")
THROUGH = {"dot": "in", "convert": "in", "constant": "value"}
ARITHMETIC = ("multiply", "divide", "add", "subtract", "invert")
CHANNELS = "rgba"


class NotRead(Exception):
    """Part of a graph that no scaled texture stands for; the message names it."""


@dataclass(frozen=True)
class Affine:
    """scale * leaf + bias. `leaf` is an image or texture coordinates, None for a constant; `channel` one of its
    channels or "rgb"; `normals` marks the output of a normal map."""

    leaf: Any
    scale: np.ndarray
    bias: np.ndarray
    channel: str = "rgb"
    normals: bool = False


def constant(value: Any) -> Affine:
    """A constant of one to four components."""
    numbers = np.atleast_1d(np.asarray(value, float))
    return Affine(None, np.zeros(3), np.resize(numbers, 3) if len(numbers) == 1 else np.resize(numbers, 4)[:3])


def value_of(port: Any, steps: list[int]) -> Affine | None:
    """The value at an input or output; None without one. `steps` counts the nodes. Raises NotRead."""
    steps.append(1)
    if len(steps) > MAX_STEPS:
        raise NotRead(f"a graph of more than {MAX_STEPS} steps")
    if port is None:
        return None
    source = port.getInterfaceInput() if port.getCategory() == "input" and port.getInterfaceName() else None
    if source is not None:
        return value_of(source, steps)
    if port.getNodeGraphString():
        output = port.getConnectedOutput()
        if output is None:
            raise NotRead(f"an absent graph '{port.getNodeGraphString()}'")
        return value_of(output, steps)
    if port.getNodeName():
        node = port.getConnectedNode()
        if node is None:
            raise NotRead(f"an absent node '{port.getNodeName()}'")
        return _of_node(node, port.getOutputString(), steps)
    numbers = floats(port.getValueString())
    if not numbers:
        return None
    encoded = port.getType().startswith("color") and port.getActiveColorSpace() == "srgb_texture"
    return constant(_linear(np.array(numbers)) if encoded else numbers)


def floats(text: str) -> list[float]:
    """The numbers of a value, none where it is a text."""
    try:
        return [float(part) for part in text.replace(",", " ").split()]
    except ValueError:
        return []


def _linear(values: np.ndarray) -> np.ndarray:
    return np.where(values <= 0.04045, values / 12.92, ((np.maximum(values, 0) + 0.055) / 1.055) ** 2.4)


def _of_node(node: Any, output: str, steps: list[int]) -> Affine | None:
    kind = node.getCategory()
    if kind in IMAGES:
        return _image(node, output, steps)
    if kind in COORDINATES:
        return Affine(node, np.ones(3), np.zeros(3))
    if kind in THROUGH:
        return value_of(node.getInput(THROUGH[kind]), steps)
    if kind in NORMAL_MAPS:
        return _normals(node, steps)
    if kind in ARITHMETIC:
        return _arithmetic(node, kind, steps)
    if kind == "extract" or kind.startswith("separate"):
        whole, index = value_of(node.getInput("in"), steps), int(_number(node, "index", 0, steps))
        letter = output[-1:] if kind != "extract" else CHANNELS[min(max(index, 0), 3)]
        return None if whole is None else _channel(whole, CHANNELS[max("xyzw".find(letter), CHANNELS.find(letter), 0)])
    raise NotRead(f"a node '{kind}'")


def _image(node: Any, output: str, steps: list[int]) -> Affine:
    one = output.removeprefix("out")
    channel = one if one in ("r", "g", "b", "a") else "r" if node.getType() == "float" else "rgb"
    result = Affine(node, np.ones(3), np.zeros(3), channel)
    for name in FACTORS.get(node.getCategory(), ()):
        result = product(result, value_of(node.getInput(name), steps) or constant(1.0))
    shift = value_of(node.getInput("bias"), steps)
    return result if shift is None else replace(result, bias=result.bias + shift.bias)


def _normals(node: Any, steps: list[int]) -> Affine | None:
    """2 c - 1, its x and y times the strength."""
    inner, strength = value_of(node.getInput("in"), steps), _number(node, "scale", 1.0, steps)
    space = node.getInput("space")
    if space is not None and space.getValueString() == "object":
        raise NotRead("an object-space normal map")
    if inner is None or inner.leaf is None:
        return None
    factor = np.array([strength, strength, 1.0])
    return replace(inner, scale=2 * inner.scale * factor, bias=(2 * inner.bias - 1) * factor, normals=True)


def _number(node: Any, name: str, default: float, steps: list[int]) -> float:
    value = value_of(node.getInput(name), steps)
    if value is not None and value.leaf is not None:
        raise NotRead(f"a textured '{name}'")
    return default if value is None else float(value.bias[0])


def _arithmetic(node: Any, kind: str, steps: list[int]) -> Affine:
    neutral = 1.0 if kind in ("multiply", "divide") else 0.0
    if kind == "invert":
        a, b = value_of(node.getInput("amount"), steps) or constant(1.0), value_of(node.getInput("in"), steps)
    else:
        a, b = value_of(node.getInput("in1"), steps), value_of(node.getInput("in2"), steps)
    a, b = a or constant(0.0), b or constant(neutral)
    if kind == "multiply":
        return product(a, b)
    if kind == "divide":
        if b.leaf is not None or not b.bias.all():
            raise NotRead("a quotient of textures")
        return product(a, constant(1 / b.bias))
    b = b if kind == "add" else product(b, constant(-1.0))
    if a.leaf is not None and b.leaf is not None:
        raise NotRead("a sum of two textures")
    return replace(a if a.leaf is not None else b, bias=a.bias + b.bias)


def product(a: Affine, b: Affine) -> Affine:
    """The product of two values, one of them a constant. Raises NotRead."""
    if a.leaf is not None and b.leaf is not None:
        raise NotRead("a product of two textures")
    first, factor = (a, b.bias) if a.leaf is not None else (b, a.bias)
    return replace(first, scale=first.scale * factor, bias=first.bias * factor)


def _channel(value: Affine, channel: str) -> Affine:
    k = CHANNELS.index(channel)
    if value.channel != "rgb":
        return value
    if channel == "a":
        return replace(value, channel="a", scale=np.ones(3), bias=np.zeros(3)) if value.leaf else constant(1.0)
    return replace(value, channel=channel, scale=np.full(3, value.scale[k]), bias=np.full(3, value.bias[k]))
