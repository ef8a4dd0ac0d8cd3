"""MAPPO (Yu et al. 2022): all agents share the advantage under a critic of the joint state."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from hipg_bench.learning.credit import CreditInputs, credit_rule


@credit_rule()
def central(inputs: CreditInputs) -> Float[Tensor, "T B 1"]:
    """Psi_i = V_targ - V(s)."""
    return inputs.target - inputs.value
