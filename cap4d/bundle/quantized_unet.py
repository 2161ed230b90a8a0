"""What the tensors of `tensors/deform_int8.safetensors` may be."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from cap4d.errors import DataError

MAX_TENSORS = 256
DTYPES = ("int8", "int32", "float32")


def check_quantized(tensors: Mapping[str, np.ndarray], *, source: str, size: int) -> None:
    """Checks the tensors of a network in whole numbers.

    Raises:
        DataError: Too many, of another dtype, or with a number that is not finite.
    """
    if not 0 < len(tensors) <= MAX_TENSORS:
        raise DataError(source, "tensors", expected=f"1 to {MAX_TENSORS}", found=len(tensors))
    for name, value in tensors.items():
        if value.dtype not in DTYPES:
            raise DataError(source, name[:64], expected=f"one of {', '.join(DTYPES)}", found=value.dtype)
        if not np.isfinite(value).all():
            raise DataError(source, name[:64], expected="finite numbers", found="another")
