"""Stable-Baselines3's PPO, trained and written into an agent's folder: docs/guides/submit.md."""

import argparse
from pathlib import Path

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from hipg_bench.adapters.sb3 import HipgVecEnv
from hipg_bench.policies.export import export_sb3

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--agent", type=Path, default=Path("sb3_ppo"), help="the folder of `submit init`")
parser.add_argument("--task", default="hazard_nav-4")
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--iterations", type=int, default=100)
args = parser.parse_args()

# the dead share the team's reward, or else dying would be a way out of a task whose rewards are costs
worlds = HipgVecEnv(args.task, num_envs=64, seed=args.seed, reward_dead="team")
num_agents = worlds.task_spec.num_agents
trained = VecNormalize(VecMonitor(worlds), norm_reward=False)  # its statistics are exported with the network

settings = {"n_steps": 50, "batch_size": 1600, "n_epochs": 4, "gamma": 0.95, "learning_rate": 1e-3}
model = PPO("MlpPolicy", trained, seed=args.seed, **settings)
curve = ["steps,return"]
for iteration in range(args.iterations):
    model.learn(trained.num_envs * 50, reset_num_timesteps=False)
    recent = np.mean([episode["r"] for episode in model.ep_info_buffer])
    curve.append(f"{model.num_timesteps // num_agents},{recent:.4f}")
    print(f"iteration {iteration}: return {recent:.2f}", flush=True)

policy = args.agent / args.task / f"seed{args.seed}.safetensors"
export_sb3(model, policy)
policy.with_suffix(".curve.csv").write_text("\n".join(curve) + "\n")
print(policy)
