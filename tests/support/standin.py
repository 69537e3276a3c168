"""A device that is not there: tensors say they lie on it, refuse others beside them, and are computed on the CPU.

It stands for a GPU where none is at hand. A tensor of the CPU that meets one of the device's is refused as CUDA does,
so that whatever was left behind shows; and the bytes that are alive on it are counted.
"""

import gc
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

NAME = "cuda"
DEVICE = torch.device(NAME, 0)
_alive: "weakref.WeakValueDictionary[int, There]" = weakref.WeakValueDictionary()


class There(torch.Tensor):
    """A tensor that lies on the stand-in device; `here` holds its numbers."""

    here: torch.Tensor

    @staticmethod
    def __new__(cls, here: torch.Tensor, requires_grad: bool = False) -> "There":
        made = torch.Tensor._make_wrapper_subclass(
            cls,
            here.size(),
            strides=here.stride(),
            storage_offset=here.storage_offset(),
            dtype=here.dtype,
            device="meta",  # of which every build of torch knows; Python is told otherwise
            requires_grad=requires_grad,
        )
        made.here = here
        _alive[id(made)] = made
        return made

    @property
    def data(self) -> torch.Tensor:
        return self.detach()

    @data.setter
    def data(self, value: "There") -> None:
        torch.Tensor.data.__set__(self, value)
        self.here = value.here

    device = property(lambda self: DEVICE)
    is_meta = property(lambda self: False)
    is_cuda = property(lambda self: True)

    def __repr__(self, *, tensor_contents: Any = None) -> str:
        return f"There({self.here!r})"

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return computed(func, args, kwargs or {})


def computed(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """An operation on the CPU's numbers; its results lie where its tensors did, or where it was told to put them."""
    tensors = [t for x in (*args, *kwargs.values()) for t in (x if isinstance(x, (list, tuple)) else (x,))]
    tensors = [t for t in tensors if isinstance(t, torch.Tensor)]
    there = any(isinstance(t, There) for t in tensors)
    asked = kwargs.get("device")
    at = None if asked is None else torch.device(asked).type
    if not there and at != NAME:
        return func(*args, **kwargs)
    moving = func in (torch.ops.aten._to_copy.default, torch.ops.aten.copy_.default)
    if there and not moving and any(not isinstance(t, There) and t.dim() > 0 for t in tensors):
        raise RuntimeError(f"{func}: expected all tensors on the same device, found at least two, {DEVICE} and cpu")
    if func is torch.ops.aten._fused_sdp_choice.default:
        return 0  # the plain formula; the others are kernels of single devices
    goes = at in (None, "meta", NAME)
    if goes and asked is not None:
        kwargs = kwargs | {"device": torch.device("cpu")}
    result = func(*(here(x) for x in args), **{k: here(x) for k, x in kwargs.items()})
    if func is torch.ops.aten.copy_.default or func.__name__.split(".")[0].endswith("_"):
        return args[0]
    return sent(result) if goes else result


def here(x: Any) -> Any:
    """What an operation of the CPU takes in the place of an argument."""
    if isinstance(x, (list, tuple)):
        return type(x)(map(here, x))
    return x.here if isinstance(x, There) else x


def sent(x: Any) -> Any:
    """A result as it lies on the device."""
    if isinstance(x, (list, tuple)):
        return type(x)(map(sent, x))
    return There(x) if isinstance(x, torch.Tensor) else x


class Names(TorchFunctionMode):
    """While on, the device's name means its number 0: torch would ask a driver for the current one."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        def numbered(x: Any) -> Any:
            return DEVICE if x == NAME or (isinstance(x, torch.device) and x.type == NAME) else x

        if func is torch.Tensor.to and len(args) == 2 and isinstance(args[1], There):
            args = args[0], DEVICE, args[1].dtype
        args = tuple(numbered(x) if isinstance(x, (str, torch.device)) else x for x in args)
        kwargs = {k: numbered(x) if k == "device" else x for k, x in (kwargs or {}).items()}
        if func is torch.nn.functional.scaled_dot_product_attention and kwargs.get("is_causal"):
            rows, columns = args[0].shape[-2], args[1].shape[-2]
            hidden = torch.full((rows, columns), -torch.inf, dtype=args[0].dtype).triu(1)
            kwargs |= {"is_causal": False, "attn_mask": hidden.to(args[0].device)}  # torch makes its own elsewhere
        if func is torch.tensor and kwargs.get("device") == DEVICE:
            return func(*args, **kwargs | {"device": "cpu"}).to(DEVICE)
        return func(*args, **kwargs)


class Moves(TorchDispatchMode):
    """While on, tensors of the CPU can be made on the device, or sent to it."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return computed(func, args, kwargs or {})


def bytes_alive() -> int:
    """Bytes of the tensors on the device that somebody still holds, each storage once."""
    gc.collect()
    storages = {t.here.untyped_storage().data_ptr(): t.here.untyped_storage().nbytes() for t in list(_alive.values())}
    return sum(storages.values())


TOTAL = 80_000_000_000


@contextmanager
def device(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[int]]:
    """mistyle's networks run on the stand-in device while this is open; yields the bytes that were alive on it each
    time that somebody asked how much is free."""
    from diffusers.pipelines import pipeline_utils

    from mistyle.stylization.models import load as models_load

    monkeypatch.setattr(models_load, "device_of", lambda settings: NAME)
    monkeypatch.setattr(pipeline_utils, "get_device", lambda: NAME)
    # torch is told that CUDA is ready.
    monkeypatch.setattr(torch.cuda, "_lazy_init", lambda: None)
    found: list[int] = []

    def free() -> tuple[int, int]:
        found.append(bytes_alive())
        return TOTAL - found[-1], TOTAL

    monkeypatch.setattr(torch.cuda, "mem_get_info", free)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation=True: True)
    with Names(), Moves():
        yield found
