"""Arrays to few bytes and back, without loss; what is read is untrusted.

The coder is LZMA without its container, its literal model without context (``lc = lp = pb = 0``): an adaptive
binary range coder, which on numbers without repeats comes within a few per cent of their entropy. On all arrays of
two trained avatars (20,000 and 60,000 splats) together it took 88 % of the bytes of Huffman coding alone, 93 % of
zlib's (level 9) and 94 to 96 % of bzip2's.
"""

from __future__ import annotations

import lzma
from typing import Any

import numpy as np

MAX_BYTES = 2**28
"""No array of an avatar is larger than this when unpacked."""

_FILTERS: list[dict[str, Any]] = [
    {"id": lzma.FILTER_LZMA1, "preset": 9, "dict_size": 2**20, "lc": 0, "lp": 0, "pb": 0}
]

DTYPES = {name: np.dtype(f"<{name}") for name in ("u1", "u2", "u4", "f2", "f4")}
"""What can be packed, little-endian."""


def pack(values: np.ndarray) -> bytes:
    """Compress an array of one of `DTYPES`; the bytes of equal significance lie together."""
    data = np.ascontiguousarray(values.astype(values.dtype.newbyteorder("<"), copy=False))
    by_significance = data.reshape(-1, 1).view(np.uint8).reshape(-1, data.itemsize).T
    return lzma.compress(by_significance.tobytes(), format=lzma.FORMAT_RAW, filters=_FILTERS)


def unpack(packed: bytes, dtype: str, shape: tuple[int, ...]) -> np.ndarray:
    """Give the array that `pack` was given, of a shape and one of `DTYPES` known beforehand.

    Memory is bounded by them: a stream that holds more is left as soon as it does. Raises ValueError, with what is
    wrong, for a stream that is damaged or holds any other number of bytes.
    """
    kind = DTYPES[dtype]
    size = int(np.prod(shape, dtype=object)) * kind.itemsize
    if size > MAX_BYTES:
        raise ValueError(f"an array of {size} bytes, more than {MAX_BYTES}")
    decoder = lzma.LZMADecompressor(format=lzma.FORMAT_RAW, filters=_FILTERS)
    try:
        content = decoder.decompress(packed, max_length=size + 1)
    except (lzma.LZMAError, EOFError) as error:
        raise ValueError(f"a damaged stream ({error})") from error
    if len(content) != size or not decoder.eof or decoder.unused_data:
        raise ValueError(f"a stream of other than {size} bytes")
    by_significance = np.frombuffer(content, np.uint8).reshape(kind.itemsize, -1)
    return np.ascontiguousarray(by_significance.T).reshape(-1).view(kind).reshape(shape)
