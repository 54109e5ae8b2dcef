"""Fast matrix products for the networks of training; everything else stays in full float32."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def fast_products(device: torch.device) -> Iterator[None]:
    """Let matrix products of float32 be computed in fewer bits: bfloat16 on a CPU, TF32 on a GPU.

    Sums and weights remain float32. A processor without units for bfloat16 computes in float32 as before.

    Args:
        device: Device of the matrices.
    """
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("medium" if device.type == "cpu" else "high")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)
