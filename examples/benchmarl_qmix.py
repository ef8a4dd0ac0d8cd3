"""BenchMARL's QMIX, on actions made discrete: each agent pushes along one axis at a time, or rests."""

import argparse
import tempfile

from benchmarl.algorithms import QmixConfig
from benchmarl.experiment import Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig

from hipg_bench.adapters.benchmarl import HipgTask


def settings(frames: int, folder: str) -> ExperimentConfig:
    """BenchMARL's own, but for less to be run on a laptop."""
    config = ExperimentConfig.get_from_yaml()
    config.save_folder, config.loggers, config.lr = folder, [], 3e-4
    config.max_n_frames, config.evaluation = frames, False
    config.off_policy_n_envs_per_worker, config.off_policy_collected_frames_per_batch = 40, 2000
    config.off_policy_n_optimizer_steps, config.off_policy_train_batch_size = 100, 256
    return config


def main() -> None:
    """Train; BenchMARL's progress bar shows the mean return."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="HAZARD_NAV_4", choices=HipgTask.__members__)
    parser.add_argument("--bins", type=int, default=2, help="strengths of a push, from -1 to 1")
    parser.add_argument("--frames", type=int, default=40_000)
    parser.add_argument("--folder", help="for checkpoints and logs; none are kept without it")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        experiment = Experiment(
            task=HipgTask[args.task].get_task(config={"bins": args.bins}),
            algorithm_config=QmixConfig.get_from_yaml(),
            model_config=MlpConfig.get_from_yaml(),
            seed=0,
            config=settings(args.frames, args.folder or scratch),
        )
        experiment.run()
        print(f"mean return {experiment.mean_return:.2f}")


if __name__ == "__main__":
    main()
