"""One way in for every array function of this package: numpy or torch, checked, broadcast."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from array_api_compat import array_namespace, is_torch_array

Array: TypeAlias = Any
"""A numpy array or a torch tensor; array functions answer in the kind they were given."""


def load(caller: str, **named: tuple[Array, tuple[int, ...]]) -> tuple[Any, ...]:
    """Return (xp, array, ...): the array namespace and the arguments, floating point, with common leading dimensions.

    Each argument is ``name=(value, trailing shape)``. Where one of them is a torch tensor, the others become tensors
    on its device (float32 if all tensors are); otherwise all become numpy arrays (sequences and scalars are
    accepted). Raises ValueError which names the caller, the argument, and the expected and received shapes.
    """
    tensors = [value for value, _ in named.values() if is_torch_array(value)]
    tensor = tensors[0] if tensors else None
    xp = array_namespace(tensor if tensors else np.empty(0))
    single = tensors and all(value.dtype == xp.float32 for value in tensors)
    dtype = xp.float32 if single else xp.float64
    arrays = {}
    for name, (value, trailing) in named.items():
        array = _floating(xp, value, tensor, dtype)
        shape = tuple(array.shape)
        if len(shape) < len(trailing) or shape[len(shape) - len(trailing) :] != trailing:
            raise ValueError(f"{caller}: {name}: expected shape {_spelled(trailing)}, received {shape}")
        arrays[name] = (array, shape[: len(shape) - len(trailing)], trailing)
    try:
        leading = np.broadcast_shapes(*(shape for _, shape, _ in arrays.values()))
    except ValueError:
        received = ", ".join(f"{name} {tuple(array.shape)}" for name, (array, _, _) in arrays.items())
        raise ValueError(f"{caller}: expected leading dimensions that broadcast, received {received}") from None
    return xp, *(
        array if shape == leading else xp.broadcast_to(array, leading + trailing)
        for array, shape, trailing in arrays.values()
    )


def _floating(xp: Any, value: Array, like: Array | None, dtype: Any) -> Array:
    if like is not None:
        if not is_torch_array(value):
            # through a fresh numpy array: torch warns about read-only memory
            value = xp.asarray(np.array(value, dtype=np.float64))
        return value.to(dtype=dtype, device=like.device)
    return np.asarray(value, dtype=np.float64)


def _spelled(trailing: tuple[int, ...]) -> str:
    return "(" + ", ".join(["...", *map(str, trailing)]) + ")"
