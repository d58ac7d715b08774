"""lerobot-wmrl-train: train a policy further by reinforcement learning, in a world model or any environment.

    lerobot-wmrl-train --policy.path=outputs/sft --env.type=world_model --env.world_model_path=W \\
        --env.text_world_model_path=X --env.dataset.root=D --gate.dataset.root=ROLLOUTS --output_dir=rl
    lerobot-wmrl-train --policy.path=outputs/sft --env.type=wmrl_maniskill --num_envs=2 --output_dir=rl

Before the first update the gate measures the world model's false positive rate: how many failures it predicts
as successes. It needs labelled rollouts (`--gate.dataset.root=ROLLOUTS`) or an environment to record some
in (`--real_env.type=wmrl_maniskill …`). Above `--gate.limit` the training stops.
`--selection.freq=5` measures success every five iterations, in `--real_env` if it is set, and keeps the best
checkpoint as `checkpoints/best`.
`--dyna.rounds=2` trains the world model further, twice, on new rollouts of the current policy.
`--policy.push_to_hub=true --policy.repo_id=USER/NAME` publishes the best checkpoint, or the last one without
selection.

Running the same command again continues from the last checkpoint. `--preset=demo` sets the sizes.
`lerobot-eval --policy.path=outputs/rl/checkpoints/best/pretrained_model …` evaluates the result.
"""

from contextlib import nullcontext
from functools import partial
from pathlib import Path

import draccus
from accelerate import PartialState
from lerobot.configs.policies import PreTrainedConfig
from lerobot.utils.random_utils import set_seed

from lerobot_wmrl.common.checkpoints import (
    BEST_CHECKPOINT_LINK,
    checkpoint_digest,
    link_checkpoint,
    link_latest,
    newest_checkpoint,
    require_resumable,
)
from lerobot_wmrl.common.command_line import run_command
from lerobot_wmrl.common.distributed import (
    LONGEST_WAIT,
    is_first_process,
    rank_and_size,
    reseed_other_ranks,
    wait_for_all,
)
from lerobot_wmrl.common.errors import FieldError, within
from lerobot_wmrl.common.output_folders import Claim
from lerobot_wmrl.common.pipeline import make_pipeline, unchanged
from lerobot_wmrl.common.policies import LoadedPolicy, with_new_adapters
from lerobot_wmrl.common.precision import keep_freed_memory
from lerobot_wmrl.common.presets import expand_preset
from lerobot_wmrl.common.tracking import make_wandb
from lerobot_wmrl.envs.configuration_world_model import WorldModelEnv
from lerobot_wmrl.envs.content import content_of
from lerobot_wmrl.envs.lerobot_env import make_tensor_env
from lerobot_wmrl.envs.tensor_env import TensorEnv
from lerobot_wmrl.envs.world_model_env import WorldModelVectorEnv
from lerobot_wmrl.rl.budget import charge_steps, check_data
from lerobot_wmrl.rl.callbacks import has_record, read_records
from lerobot_wmrl.rl.compatibility import match_policy_to_env, rollout_length, settle_discount
from lerobot_wmrl.rl.configuration_train import MAY_DIFFER, TrainConfig, resolve_policy
from lerobot_wmrl.rl.dyna import round_iterations
from lerobot_wmrl.rl.make_callbacks import make_callbacks
from lerobot_wmrl.rl.rollout import RolloutBuffer
from lerobot_wmrl.rl.selection import IMAGINED, REAL, Selection, best_checkpoint
from lerobot_wmrl.rl.trained_policy import publish, summary
from lerobot_wmrl.rl.trainer import Schedule, make_algorithm, train


def train_policy(cfg: TrainConfig) -> None:
    """Load the policy, build the environment, train, publish, and say what was made."""
    cfg.validate()
    settle_discount(cfg)
    check_data(cfg, cfg.env)
    config = resolve_policy(cfg)
    if isinstance(cfg.env, WorldModelEnv) and cfg.env.device not in (None, config.device):
        raise FieldError(
            "env.device",
            cfg.env.device,
            f"the policy is on {config.device}, and the world model too",
            "set `policy.device` instead",
        )
    cfg.algorithm.check_policy(config)
    PartialState(cpu=config.device == "cpu", timeout=LONGEST_WAIT)
    content, done = named_content(cfg, config), finished(cfg)
    wait_for_all()  # no process has written anything before all have looked
    # encoded now, because an environment of the hub tells its configuration of its actions
    claim = Claim(cfg.output_dir, draccus.encode(cfg), MAY_DIFFER, content)
    claim.check()
    if done:
        if is_first_process():
            link_latest(cfg.output_dir)
            link_best(cfg)
        print(f"{cfg.output_dir}: already trained for {cfg.iterations} iterations")
    else:
        set_seed(cfg.seed)
        policy = LoadedPolicy.load(config)
        with within("env"):
            env = make_tensor_env(cfg.env, cfg.num_envs, config.device or "cpu")
        try:
            train_in(env, cfg, claim, policy)
        finally:
            env.close()
    if is_first_process():
        lines = summary(cfg)
        print("\n".join(lines))
        publish(cfg, lines)


def named_content(cfg: TrainConfig, policy: PreTrainedConfig) -> dict[str, str]:
    """Return digests of the policy that is trained, and of what imagined episodes follow from."""
    path = policy.pretrained_path
    trained = {"policy": checkpoint_digest(path)} if path else {}
    with within("env"):
        return trained | content_of(cfg.env)


def finished(cfg: TrainConfig) -> bool:
    """Return whether the run has reached its last iteration. FieldError if there is nothing to resume."""
    last = newest_checkpoint(cfg.output_dir)
    if cfg.resume:
        require_resumable(cfg.output_dir)
    if last is None or int(last.name) < cfg.iterations:
        return False
    return not cfg.selection.freq or has_record(
        cfg.output_dir, Selection.name, cfg.iterations, cfg.iterations
    )


def link_best(cfg: TrainConfig) -> None:
    """Point `best` at the best checkpoint of a finished run: a kill may have come before that."""
    if records := read_records(cfg.output_dir, Selection.name) if cfg.selection.freq else {}:
        judge = REAL if REAL in records[cfg.iterations] else IMAGINED
        refreshed = round_iterations(cfg.dyna.rounds, cfg.iterations)
        best = best_checkpoint(cfg.output_dir, cfg.iterations, records, judge, refreshed)
        link_checkpoint(best, BEST_CHECKPOINT_LINK)


def train_in(env: TensorEnv, cfg: TrainConfig, claim: Claim, policy: LoadedPolicy) -> None:
    """Check that policy and environment fit, then train in the output folder of the claim."""
    config = policy.config
    match_policy_to_env(cfg, policy, env)
    if cfg.peft is not None:
        policy.policy = with_new_adapters(policy.policy, cfg.peft)
    algorithm = make_algorithm(policy.policy, cfg.algorithm, cfg.output_dir)
    reseed_other_ranks(cfg.seed)  # of which the distilled policy's loss draws some
    shown = env.store_compact() if isinstance(env, WorldModelVectorEnv) else unchanged
    pipeline = make_pipeline(config, *policy.processors, shown=shown)
    algorithm.check_dataset(env, pipeline)
    longest = env.max_episode_steps
    buffer = RolloutBuffer(rollout_length(cfg, longest), cfg.num_envs, config.device, longest)
    callbacks = make_callbacks(cfg, policy, env)

    def save_pretrained(folder: Path) -> None:
        for part in (policy.policy, config, *policy.processors, cfg):
            part.save_pretrained(folder)

    schedule = Schedule(cfg.iterations, cfg.save_freq, cfg.seed, cfg.log_freq)
    first = is_first_process()
    with claim.held() if first else nullcontext():
        if first and cfg.budget is not None and not isinstance(cfg.env, WorldModelEnv):
            steps = cfg.iterations * cfg.num_envs * rank_and_size()[1] * buffer.steps
            charge_steps(cfg.budget, cfg.output_dir, steps, env.max_episode_steps)
        train(
            env,
            algorithm,
            pipeline,
            buffer,
            schedule,
            cfg.output_dir,
            save_pretrained,
            callbacks,
            make_wandb(cfg),
        )


def main() -> None:
    """Entry point of the console command."""
    keep_freed_memory()
    run_command(train_policy, TrainConfig, partial(expand_preset, command="train"))
    PartialState().destroy_process_group()


if __name__ == "__main__":
    main()
