"""PPO in one file, as CleanRL has it, over Gymnasium's vector API: one network acts for the whole team."""

import argparse
import copy

import gymnasium as gym
import numpy as np
import torch
from torch import nn
from torch.distributions import Normal

import hipg_bench.gym  # noqa: F401 (registers the tasks)

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--task", default="hipg/coop_nav-3-v1")
parser.add_argument("--iterations", type=int, default=300)
args = parser.parse_args()
B, T, GAMMA, LAMBDA = 64, 50, 0.95, 0.95
torch.manual_seed(0)

envs = gym.make_vec(args.task, num_envs=B, autoreset_mode="SameStep")
inputs, outputs = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]
layers = [nn.Linear(inputs, 128), nn.Tanh(), nn.Linear(128, 64), nn.Tanh()]
actor, critic = (nn.Sequential(*copy.deepcopy(layers), nn.Linear(64, size)) for size in (outputs, 1))
nn.init.orthogonal_(actor[-1].weight, 0.01)
log_std = nn.Parameter(torch.full((outputs,), -0.5))
parameters = [*actor.parameters(), *critic.parameters(), log_std]
adam = torch.optim.Adam(parameters, lr=1e-3, eps=1e-5)

seen = torch.from_numpy(envs.reset(seed=0)[0])
for iteration in range(args.iterations):
    steps, team_return, gain, gains = [], 0.0, torch.zeros(B), []
    for _ in range(T):
        with torch.no_grad():
            policy = Normal(actor(seen), log_std.exp())
            action = policy.sample()
            after, reward, terminated, truncated, info = envs.step(action.numpy())
            done, last = terminated | truncated, after.copy()
            if done.any():  # what ended worlds showed last, not what their next episodes begin with
                last[done] = np.stack(info["final_obs"][done])
            # a time limit is no failure: what would come after it counts
            future = critic(torch.from_numpy(last))[:, 0] * torch.from_numpy(~terminated)
            surprise = torch.from_numpy(reward).float() + GAMMA * future - critic(seen)[:, 0]
            steps.append((seen, action, policy.log_prob(action).sum(1), surprise, torch.from_numpy(~done)))
        seen, team_return = torch.from_numpy(after), team_return + reward.mean()
    for *_, surprise, goes_on in reversed(steps):
        gain = surprise + GAMMA * LAMBDA * goes_on * gain
        gains.insert(0, gain)
    obs, act, old = (torch.cat([step[k] for step in steps]) for k in range(3))
    advantage, target = torch.cat(gains), torch.cat(gains) + critic(obs)[:, 0].detach()
    for pick in torch.cat([torch.randperm(B * T) for _ in range(4)]).split(800):
        ratio = (Normal(actor(obs[pick]), log_std.exp()).log_prob(act[pick]).sum(1) - old[pick]).exp()
        gain = (advantage[pick] - advantage[pick].mean()) / (advantage[pick].std() + 1e-8)
        surrogate = torch.min(ratio * gain, ratio.clamp(0.8, 1.2) * gain).mean()
        adam.zero_grad()
        (0.5 * (critic(obs[pick])[:, 0] - target[pick]).square().mean() - surrogate).backward()
        nn.utils.clip_grad_norm_(parameters, 0.5)
        adam.step()
    print(f"iteration {iteration}: return {team_return:.2f}", flush=True)
