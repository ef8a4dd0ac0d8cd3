"""The Philox generator, 4 x 64 bits in ten rounds, as a compiled loop: every episode has a stream of its own.

What comes out is, bit for bit, what NumPy's ``Generator(Philox(...)).random`` gives, in a fraction of the
time that setting its state takes. Source: Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", 2011.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt64

from hipg_bench.native import compiled

_FACTOR0, _FACTOR1 = np.uint64(0xD2E7470EE14C6C93), np.uint64(0xCA5A826395121157)
_WEYL0, _WEYL1 = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBB67AE8584CAA73B)
"""By which the key grows from round to round."""
_ROUNDS = 10
_ZERO, _HALF, _LOW = np.uint64(0), np.uint64(32), np.uint64(0xFFFFFFFF)
_UNUSED = np.uint64(11)
"""Bits of a word that a double has no room for."""
_ULP = 2.0**-53


@compiled
def uniform(
    key: UInt64[np.ndarray, "2"], stream: UInt64[np.ndarray, "n"], chance: Float[np.ndarray, "n size"]
) -> None:
    """Draw uniform numbers in [0, 1) from counters (1, 0, 0, stream), (2, 0, 0, stream), ...

    Args:
        key: of the generator.
        stream: highest word of each row's counter.
        chance: written into.
    """
    rows, size = chance.shape
    for row in range(rows):
        for start in range(0, size, 4):
            a, b, c, d = np.uint64(start // 4 + 1), _ZERO, _ZERO, stream[row]
            x, y = key[0], key[1]
            for _ in range(_ROUNDS):
                a, b, c, d = high(_FACTOR1, c) ^ b ^ x, _FACTOR1 * c, high(_FACTOR0, a) ^ d ^ y, _FACTOR0 * a
                x += _WEYL0
                y += _WEYL1
            for k, word in enumerate((a, b, c, d)):
                if start + k < size:
                    chance[row, start + k] = (word >> _UNUSED) * _ULP


@compiled
def high(a: np.uint64, b: np.uint64) -> np.uint64:
    """The higher word of a product of two words."""
    low_a, high_a, low_b, high_b = a & _LOW, a >> _HALF, b & _LOW, b >> _HALF
    middle = high_a * low_b + ((low_a * low_b) >> _HALF)
    return high_a * high_b + (middle >> _HALF) + ((low_a * high_b + (middle & _LOW)) >> _HALF)
