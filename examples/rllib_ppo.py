"""PPO of RLlib's new API stack: the team shares one network, and the dead leave the episode.

python examples/rllib_ppo.py --task hazard_nav-4 --iterations 20
"""

import argparse

import ray
from ray.rllib.algorithms.ppo import PPOConfig

import hipg_bench
from hipg_bench.adapters.rllib import HipgMultiAgentEnv


def configure(task: str, workers: int, steps: int) -> PPOConfig:
    """One policy for all agents, the same seed for every run."""
    return (
        PPOConfig()
        .environment(HipgMultiAgentEnv, env_config={"task": task})
        .multi_agent(policies={"team"}, policy_mapping_fn=lambda agent, *_, **__: "team")
        .env_runners(num_env_runners=workers, num_envs_per_env_runner=8)
        .training(train_batch_size_per_learner=steps, minibatch_size=512, num_epochs=8, lr=5e-4, gamma=0.95)
        .debugging(seed=0, log_level="ERROR")
    )


def main() -> None:
    """Train, and print the return after each iteration."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="hazard_nav-4")
    parser.add_argument("--iterations", type=int, default=20)
    parser.add_argument("--steps", type=int, default=4000, help="control steps per iteration")
    parser.add_argument("--workers", type=int, default=0, help="processes that play; 0: this one")
    args = parser.parse_args()
    ray.init("local", num_cpus=args.workers + 1, include_dashboard=False, log_to_driver=False)
    try:
        algorithm = configure(args.task, args.workers, args.steps).build_algo()
        for iteration in range(args.iterations):
            played = algorithm.train()["env_runners"]
            # RLlib adds up what the agents got: each is paid the team's reward while it lives
            mean = played["episode_return_mean"] / hipg_bench.task_spec(args.task).num_agents
            print(f"iteration {iteration}: mean return of an agent {mean:.2f}", flush=True)
        algorithm.stop()
    finally:
        ray.shutdown()


if __name__ == "__main__":
    main()
