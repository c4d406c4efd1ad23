"""A device pretended over CPU memory, as strict as a GPU about where values are, that counts what a GPU would be asked for.

It is torch's PrivateUse1 with wrapped CPU tensors: values of both devices in one operation, ``.numpy()`` and CPU generators
are refused, as CUDA refuses them.
"""

from __future__ import annotations

import functools
import subprocess
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._mode_utils import no_dispatch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

DEVICE = "pretended"
AT = torch.device("privateuseone", 0)
READS = {
    "_local_scalar_dense",
    "nonzero",
    "masked_select",
    "_unique2",
    "unique_dim",
    "unique_consecutive",
    "equal",
}
"""Operations whose result, or its size, the host has to wait for."""
ACROSS = {"_to_copy", "copy_", "_copy_from", "_copy_from_and_resize"}
"""Operations that may have values of both devices."""
FREE = {
    "detach",
    "view",
    "alias",
    "_unsafe_view",
    "_reshape_alias",
    "as_strided",
    "empty",
    "empty_like",
    "empty_strided",
    "lift_fresh",
}
"""Operations that start nothing on the device, as far as `_is_view` does not know them."""


class DeviceError(RuntimeError):
    """What a GPU would refuse."""


class Pretended(Tensor):
    """A tensor on the pretended device; ``held`` is its CPU memory."""

    held: Tensor

    @staticmethod
    def __new__(cls, held: Tensor) -> Self:
        made = Tensor._make_wrapper_subclass(  # type: ignore[attr-defined]
            cls,
            held.size(),
            strides=held.stride(),
            storage_offset=held.storage_offset(),
            dtype=held.dtype,
            device=AT,
        )
        made.held = held
        return made

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return perform(function, args, kwargs or {}, Counter())


def perform(function: Any, args: Any, kwargs: dict[str, Any], counts: Counter[str]) -> Any:
    """Do one operation on the memory behind its tensors."""
    name = function._schema.name.removeprefix("aten::")
    values = tree_flatten((args, kwargs))[0]
    tensors = [value for value in values if isinstance(value, Tensor)]
    here = [value for value in tensors if isinstance(value, Pretended)]
    there = [value for value in tensors if not isinstance(value, Pretended)]
    wanted = kwargs.get("device")
    goes_here = bool(here) if wanted is None else torch.device(wanted).type == DEVICE
    if not here and not goes_here:
        return function(*args, **kwargs)
    if name in ("index", "_unsafe_index", "index_put_", "index_put") and here and there:
        counts["waits"] += 1  # torch copies such an index over
        there = [value for value in there if value.dtype not in (torch.int64, torch.bool)]
    if here and name not in ACROSS and any(value.ndim for value in there):
        raise DeviceError(f"{function}: tensors on {DEVICE} and on the CPU")
    if kwargs.get("generator") is not None:
        raise DeviceError(f"{function}: a generator of the CPU")
    count(name, function, args, kwargs, here, there, goes_here, counts)
    known = {id(value.held): value for value in here}
    if torch.Tag.inplace_view in function.tags:  # changes the form of the wrapper, too
        with no_dispatch():
            function(*args, **kwargs)
    args, kwargs = tree_map(
        lambda value: value.held if isinstance(value, Pretended) else value, (args, kwargs)
    )
    if wanted is not None:
        kwargs["device"] = torch.device("cpu")
    kwargs.pop("pin_memory", None)
    if name == "_to_copy":  # torch's own would give the same memory again
        out = function(*args, **{**kwargs, "device": torch.device("cpu")})
    else:
        out = function(*args, **kwargs)

    def wrap(value: Any) -> Any:
        if not isinstance(value, Tensor):
            return value
        if id(value) in known:
            return known[id(value)]
        return Pretended(value) if goes_here else value

    if name in ("copy_",) and not isinstance(args[0], Pretended) and id(out) not in known:
        return out
    return tree_map(wrap, out)


def count(
    name: str,
    function: Any,
    args: Any,
    kwargs: Any,
    here: list[Any],
    there: list[Any],
    goes_here: bool,
    counts: Counter[str],
) -> None:
    """Add an operation, and a wait if the host has to wait for it, to ``counts``."""
    if name in FREE or _is_view(function):
        return
    counts["operations"] += 1
    counts[f"operation {name}"] += 1
    crosses = name in ACROSS and ((here and there) or (bool(here) != goes_here))
    blocking = crosses and not (kwargs.get("non_blocking") or (name == "copy_" and len(args) > 2 and args[2]))
    masks = name in ("index", "index_put_", "index_put") and any(
        value.dtype == torch.bool for value in tree_flatten(args[1])[0] if isinstance(value, Tensor)
    )
    if name in READS or blocking or masks:
        counts["waits"] += 1
        counts[f"wait {name}"] += 1


@functools.cache
def _is_view(function: Any) -> bool:
    returned = [value.alias_info for value in function._schema.returns]
    return any(alias is not None and not alias.is_write for alias in returned)


class Device(TorchDispatchMode):
    """While it is entered the device exists; ``counts`` has its operations and the waits of the host."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: Counter[str] = Counter()

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return perform(function, args, kwargs or {}, self.counts)


class _FromLists(TorchFunctionMode):
    """`torch.tensor` and its like, which go round dispatch, as a CPU tensor and a copy."""

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if function in (torch.tensor, torch.as_tensor):
            device = kwargs.pop("device", None)
            made = function(*args, **kwargs)
            return made if device is None else made.to(device)
        if function is Tensor.new_tensor and isinstance(args[0], Pretended):
            like = {"dtype": args[0].dtype, **kwargs}
            return torch.tensor(*args[1:], **like).to(args[0].device)
        if function in (Tensor.__getitem__, Tensor.__setitem__) and isinstance(args[0], Pretended):
            where = args[1] if isinstance(args[1], tuple) else (args[1],)
            lists = (list, np.ndarray)
            where = tuple(torch.as_tensor(at).to(AT) if isinstance(at, lists) else at for at in where)
            return function(args[0], where, *args[2:])
        return function(*args, **kwargs)


class _Module:
    """What torch asks of ``torch.pretended``."""

    is_available = is_initialized = staticmethod(lambda: True)
    _is_in_bad_fork = is_autocast_enabled = staticmethod(lambda: False)
    current_device = staticmethod(lambda: 0)
    device_count = staticmethod(lambda: 1)
    get_amp_supported_dtype = staticmethod(lambda: [torch.float16])
    manual_seed_all = synchronize = staticmethod(lambda *_: None)


@functools.cache
def register() -> None:
    """Make torch know the device. Before the first gradient of the process, for which torch then starts threads.

    Compiles the device's guard, as torch's own for devices written in Python ends the process in the backward pass.
    """
    from torch.utils import backend_registration

    torch.utils.rename_privateuse1_backend(DEVICE)
    torch.utils.generate_methods_for_privateuse1_backend()
    torch._register_device_module(DEVICE, _Module())
    torch._C._acc.register_python_privateuseone_hook(backend_registration._DummyPrivateUse1Hook())
    home = Path(torch.__file__).parent
    with TemporaryDirectory() as folder:
        library = str(Path(folder) / "guard.so")
        source = str(Path(__file__).with_name("pretended_guard.cpp"))
        flags = ["-std=c++20", "-shared", "-fPIC", f"-I{home / 'include'}", f"-L{home / 'lib'}", "-lc10"]
        subprocess.run(["g++", source, *flags, "-o", library], check=True)
        torch.ops.load_library(library)


@contextmanager
def pretended() -> Iterator[Device]:
    """The pretended device, `DEVICE`."""
    register()
    with Device() as device, _FromLists():
        yield device
