"""Which worlds are played: public seeds for development, hidden ones for verified scores.

A hidden seed follows from a salt that only the host knows. The host publishes the salt's commitment
beforehand and the salt itself when the suite is replaced, so that anybody can check old rows.
"""

from __future__ import annotations

import hashlib
import hmac

from hipg_bench.errors import HipgError

SUITE = "hipg-1"
"""The suite version that is scored; `hipg_bench.evaluation.protocol` says what is frozen in it."""
FIRST_SEED = 1000
"""Evaluation seed of the first 64 public worlds; training has those below."""
WORLDS_PER_SEED = 64
"""Worlds that share an evaluation seed: a block."""
SALT_BYTES = 16
"""Fewest bytes of a salt; a shorter one could be guessed from its commitment."""


def hidden_seed(salt: bytes, split: str, task: str, block: int) -> int:
    """Evaluation seed of a block of hidden worlds: the first 63 bits of an HMAC-SHA256.

    Raises:
        HipgError: the salt is too short.
    """
    message = f"{SUITE}|{split}|{task}|{block}".encode()
    return int.from_bytes(hmac.digest(_checked(salt), message, "sha256")[:8], "big") >> 1


def commitment(salt: bytes) -> str:
    """What the host publishes of a salt: its SHA-256 in hex.

    Raises:
        HipgError: the salt is too short.
    """
    return hashlib.sha256(_checked(salt)).hexdigest()


def _checked(salt: bytes) -> bytes:
    if len(salt) < SALT_BYTES:
        raise HipgError(f"a salt has at least {SALT_BYTES} bytes, got {len(salt)}")
    return salt
