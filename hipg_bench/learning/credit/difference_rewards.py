"""Difference rewards from exact forks (Wolpert and Tumer 2002; Dr.Reinforce, Castellini et al. 2020).

D_i = r(s, u) - r(s without i, u): what the team's reward would have lost in this step without agent i. Others
have to learn that reward; here the world before each step is forked, agent i's health is set to 0, and the
same joint action is stepped once more, so D_i is exact. Each agent's advantage is under a critic of its own
observation that values the discounted sum of its D_i, as Dr.Reinforce's policy gradient with a baseline has
it.

Cost: one more step of every world for every living agent. No world is stepped for agents that are dead, whose
    D_i is 0.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hipg_bench.env import BatchEnv
from hipg_bench.learning.credit import CreditInputs, credit_rule
from hipg_bench.learning.critics import observation_critic
from hipg_bench.learning.rollout import Rollout
from hipg_bench.registry import make


def difference_rewards_of(data: Rollout, env: BatchEnv) -> Float[Tensor, "T B N"]:
    """D_i of every step, of the living."""
    worlds = make(env.spec, env.num_envs, threads=torch.get_num_threads(), autoreset=False)
    difference = torch.zeros_like(data.health)
    for t, rows in enumerate(data.rows):
        action, alive = data.action[t].numpy(), data.health[t].numpy() > 0
        for agent in range(env.num_agents):
            lived = np.flatnonzero(alive[:, agent])
            if len(lived) == 0:
                continue
            forked = rows.copy()
            forked[lived] = worlds.fork(rows[lived], {agent: 0.0})
            worlds.load_rows(np.arange(len(rows)), forked)
            without = torch.from_numpy(worlds.step(action).reward).float()
            difference[t, lived, agent] = (data.reward[t] - without)[lived]
    return difference


@credit_rule(critic=observation_critic, rewards=difference_rewards_of, needs_rows=True)
def difference_rewards(inputs: CreditInputs) -> Float[Tensor, "T B N"]:
    """Psi_i = D_targ,i - V(o_i), D_targ,i the lambda-return of agent i's difference rewards."""
    return inputs.target - inputs.value
