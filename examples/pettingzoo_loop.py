"""A plain PettingZoo loop: who is in the dicts, who dies, how an episode ends."""

import argparse

import hipg_bench

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--task", default="hazard_nav-4")
parser.add_argument("--episodes", type=int, default=20)
args = parser.parse_args()

env = hipg_bench.parallel_env(args.task, dead="remove", seed=0)
for episode in range(args.episodes):
    observations, infos = env.reset()
    team_return, dead = 0.0, []

    # the dead leave `agents` at once, the others when the episode is over
    while env.agents:
        actions = {agent: env.action_space(agent).sample() for agent in env.agents}
        observations, rewards, terminations, truncations, infos = env.step(actions)

        # everyone who was alive is paid the team's reward
        team_return += next(iter(rewards.values()))
        dead += [agent for agent, info in infos.items() if not info["alive"]]

    ended = "time limit" if any(truncations.values()) else "terminated"
    print(f"episode {episode}: return {team_return:.2f}, {ended}, dead: {', '.join(dead) or 'nobody'}")
env.close()
