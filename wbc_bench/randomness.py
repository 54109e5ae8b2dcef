"""Counter-based random streams: a draw depends on what it is for, never on when or where it is made."""

import zlib

import numpy as np


def stream(seed: int, purpose: str, *index: int) -> np.random.Generator:
    """The generator of one purpose (`"target"`, `"noise"`, ...) and up to three indices.

    Streams of different purposes or indices never overlap: the key holds seed and purpose, the upper words of
    the counter the indices. Source: Salmon et al. 2011 (Philox 4x64).
    """
    if len(index) > 3:
        raise ValueError(f"{len(index)} indices, at most 3")
    counter = [0, *index, *[0] * (3 - len(index))]
    key = [seed, zlib.crc32(purpose.encode())]
    return np.random.Generator(np.random.Philox(key=key, counter=np.array(counter, dtype=np.uint64)))
