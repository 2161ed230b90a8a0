"""How many threads torch takes beside a renderer that has its own."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """One, while the body (or the function that this decorates) runs.

    The C++ does the work, on threads of its own. Torch's operations are small here, and its threads wait for
    each other by spinning: on a busy machine of two cores a float64 picture took 30 s instead of 3. They also
    sum in an order that depends on their number.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
