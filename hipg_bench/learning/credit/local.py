"""IPPO (de Witt et al. 2020): each agent's advantage is under a critic of its own observation."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from hipg_bench.learning.credit import CreditInputs, credit_rule
from hipg_bench.learning.critics import observation_critic


@credit_rule(critic=observation_critic)
def local(inputs: CreditInputs) -> Float[Tensor, "T B N"]:
    """Psi_i = V_targ,i - V(o_i)."""
    return inputs.target - inputs.value
