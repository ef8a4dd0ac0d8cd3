"""Stable-Baselines3's PPO: the agents of all worlds are slots of one VecEnv and share a policy."""

import argparse

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecMonitor

from hipg_bench.adapters.sb3 import HipgVecEnv

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--task", default="hazard_nav-4")
parser.add_argument("--iterations", type=int, default=100)
args = parser.parse_args()

# the dead share the team's reward, or else dying would be a way out of a task whose rewards are costs
worlds = VecMonitor(HipgVecEnv(args.task, num_envs=64, reward_dead="team"))
test_worlds = VecMonitor(HipgVecEnv(args.task, num_envs=16, seed=1000, reward_dead="team"))

settings = {"n_steps": 50, "batch_size": 1600, "n_epochs": 4, "gamma": 0.95, "learning_rate": 1e-3}
model = PPO("MlpPolicy", worlds, seed=0, **settings)
for iteration in range(args.iterations):
    model.learn(worlds.num_envs * 50, reset_num_timesteps=False)
    recent = np.mean([episode["r"] for episode in model.ep_info_buffer])
    print(f"iteration {iteration}: return {recent:.2f}", flush=True)
mean, _ = evaluate_policy(model, test_worlds, n_eval_episodes=64)
print(f"test return {mean:.2f}")
