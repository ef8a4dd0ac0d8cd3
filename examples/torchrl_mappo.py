"""MAPPO with TorchRL: a shared actor, a critic of the joint state, and dead agents that teach nothing.

python examples/torchrl_mappo.py --task hazard_nav-4 --iterations 100
"""

import argparse

import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torchrl.collectors import Collector
from torchrl.modules import MLP, MultiAgentMLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from hipg_bench.adapters.torchrl import HipgEnv

SEES, DOES = ("agents", "observation"), ("agents", "action")


def build(env: HipgEnv) -> ClipPPOLoss:
    """The actor sees one agent's observation, the critic the joint state."""
    size = {"depth": 2, "num_cells": 64, "activation_class": torch.nn.Tanh}
    sees, does = env.observation_spec[SEES].shape[-1], env.full_action_spec[DOES].shape[-1]
    net = MultiAgentMLP(sees, 2 * does, env.spec.num_agents, centralized=False, share_params=True, **size)
    normal = {"loc": ("agents", "loc"), "scale": ("agents", "scale")}
    head = TensorDictModule(torch.nn.Sequential(net, NormalParamExtractor()), [SEES], [*normal.values()])
    chance = {"distribution_class": TanhNormal, "return_log_prob": True}
    actor = ProbabilisticActor(head, normal, [DOES], spec=env.full_action_spec[DOES], **chance)
    critic = ValueOperator(MLP(env.observation_spec["state"].shape[-1], 1, **size), ["state"])
    loss = ClipPPOLoss(actor, critic, entropy_coeff=0.003)
    loss.set_keys(advantage=("agents", "advantage"))
    return loss


parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--task", default="hazard_nav-4")
parser.add_argument("--iterations", type=int, default=100, help="of one episode in each of 64 worlds")
args = parser.parse_args()
torch.manual_seed(0)
# the team goes on being charged for members it has lost: nobody is better off dead
env = HipgEnv(args.task, num_envs=64, reward_dead="team")
loss = build(env)
gae = GAE(gamma=0.95, lmbda=0.95, value_network=loss.critic_network, average_gae=True)
adam = torch.optim.Adam(loss.parameters(), 1e-3)
frames = 64 * env.spec.horizon
play = {"frames_per_batch": frames, "total_frames": frames * args.iterations}
collector = Collector(env, loss.actor_network, **play, auto_register_policy_transforms=False)
for iteration, batch in enumerate(collector):
    batch["next", "reward"] = batch["next", "agents", "reward"][..., 0, :]
    gae(batch)
    batch["agents", "advantage"] = torch.where(batch["agents", "alive"], batch["advantage"][..., None], 0.0)
    for part in torch.cat([torch.randperm(frames) for _ in range(5)]).split(frames // 4):
        losses = loss(batch.reshape(frames)[part])
        adam.zero_grad()
        (losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]).backward()
        adam.step()
    print(f"iteration {iteration}: return {batch['next', 'reward'].sum(1).mean():.2f}", flush=True)
