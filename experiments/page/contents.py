"""The chapters and sections of docs/results.md, in their order: of each study a title, and what writes it."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Final, NamedTuple

from experiments.page import (
    act,
    codes,
    controls,
    foreign,
    four_tasks,
    judged,
    policies,
    rewards,
    same_recordings,
    speed,
    value,
    value_cells,
    world_models,
)
from experiments.page.cells import Load


class Section(NamedTuple):
    """A section: its title, and the Markdown below it, made from docs/results."""

    title: str
    write: Callable[[Load], str]


SECOND_ROWS: Final = partial(value.rows_above, study=value_cells.SECOND_STUDY, parts=value_cells.SECOND_PARTS)

TASKS_ROWS: Final = partial(value.rows_above, study=value_cells.TASKS_STUDY, parts=value_cells.TASKS_PARTS)

CHAPTERS: Final[Mapping[str, Mapping[str, Section]]] = {
    "Push": {
        "value_push": Section("Imagination against the best use of the same data", value.value_push),
        "value_same_recordings": Section(
            "More demonstrations or fewer rollouts, on the same recordings for all methods",
            same_recordings.section,
        ),
        "value_rewards": Section("Rewards, and all methods on the same recordings", rewards.section),
        "value_longer": Section("Longer BC", partial(value.rows_above, ["longer", "longer_filtered"])),
        "value_longer_imagined": Section(
            "PPO and distillation from longer BC",
            partial(value.rows_above, ["longer_imagined_ppo", "longer_ppo_distilled"]),
        ),
        "value_without_noise": Section(
            "Rollouts without exploration noise",
            partial(value.rows_above, ["noiseless", "longer_noiseless"]),
        ),
        "value_iterated": Section(
            "Rollouts in three rounds",
            partial(value.rows_above, ["iterated", "iterated_ppo", "iterated_ppo_distilled"]),
        ),
        "value_simulator": Section("PPO in ManiSkill", partial(value.rows_above, ["simulated_ppo"])),
        "value_dyna": Section("Dyna rounds", partial(value.rows_above, ["dyna"])),
        "value_imagined": Section(
            "Cloning imagined successes", partial(value.rows_above, ["imagined_cloning"])
        ),
        "value_others": Section("RECAP, distillation alone, PPO without a reward", value.value_others),
        "value_distilled_ppo": Section(
            "PPO after distillation", partial(value.rows_above, ["distilled_ppo"])
        ),
        "value_ppo_distilled": Section(
            "Distillation after PPO", partial(value.rows_above, ["ppo_distilled"])
        ),
        "value_time_limit": Section("Twice as many steps an episode", codes.time_limit),
        "value_controls": Section("Wrong labels, wrong actions, fewer episodes", controls.value_controls),
        "driven": Section("Demonstrations that somebody drives in a world model", policies.driven),
    },
    "Other tasks": {
        "value_pick_place": Section(
            "Pick and place: imagination against the best use of the same data", value.value_pick_place
        ),
        "value_pick_place_longer_imagined": Section(
            "Pick and place: PPO from longer BC", partial(SECOND_ROWS, ["longer_imagined_ppo"])
        ),
        "value_pick_place_discount": Section(
            "Pick and place: the discount",
            partial(SECOND_ROWS, ["longer_filtered", "longer_discounted_ppo", "discounted_ppo"]),
        ),
        "value_pick_place_simulator": Section(
            "Pick and place: PPO in ManiSkill", partial(SECOND_ROWS, ["simulated_ppo"])
        ),
        "value_pick_place_dyna": Section("Pick and place: Dyna rounds", partial(SECOND_ROWS, ["dyna"])),
        "value_pick_place_iterated": Section(
            "Pick and place: rollouts in three rounds", partial(SECOND_ROWS, ["iterated", "iterated_ppo"])
        ),
        "value_tasks": Section(
            "Pull, move to aim: imagination against the best use of the same data", value.value_tasks
        ),
        "value_tasks_simulator": Section(
            "Pull, move to aim: PPO in ManiSkill", partial(TASKS_ROWS, ["simulated_ppo"])
        ),
        "value_four_tasks": Section("One policy for four tasks", four_tasks.section),
        "value_four_tasks_simulator": Section(
            "One policy for four tasks: PPO in ManiSkill",
            partial(four_tasks.column_above, part="value_four_tasks_simulator"),
        ),
        "value_four_tasks_others": Section(
            "One policy for four tasks: longer filtered BC",
            partial(four_tasks.column_above, part="value_four_tasks_others"),
        ),
        "value_four_tasks_ppo_distilled": Section(
            "One policy for four tasks: distillation after PPO",
            partial(four_tasks.column_above, part="value_four_tasks_ppo_distilled"),
        ),
        "metaworld": Section("Meta-World", foreign.section),
    },
    "Other policies": {
        "value_act": Section("ACT", act.section),
        "value_act_controls": Section("ACT: wrong labels, wrong actions", act.controls_section),
        "openvla_small": Section("A small OpenVLA", policies.openvla_small),
    },
    "The demo's task, before the budget of real episodes": {
        "demo": Section("The demo", policies.demo),
        "cloning_control": Section("BC of more and better demonstrations", policies.cloning_control),
        "rl_comparison": Section("PPO in the world model and in ManiSkill", policies.rl_comparison),
        "planning": Section("Planning without a policy", policies.planning),
        "synthetic_data": Section("Cloning imagined or simulated successes", policies.synthetic_data),
        "imagined_ppo": Section("PPO from policies that are good already", policies.imagined_ppo),
    },
    "Trust": {
        "gate": Section("The gate in three scenes", world_models.gate),
        "gate_one_scene": Section("The gate in one scene", world_models.gate_one_scene),
        "gate_autoregressive": Section(
            "The gate with autoregressive dynamics", world_models.gate_autoregressive
        ),
        "gate_sensitivity": Section(
            "How precisely the object must be located", world_models.gate_sensitivity
        ),
        "policies": Section("Success in the world model and in ManiSkill", world_models.policies),
        "judge": Section("Judging policies in a world model", judged.section),
        "reward_curves": Section("Rewards along episodes", world_models.reward_curves),
    },
    "World models": {
        "four_tasks": Section("One world model for four tasks", world_models.four_tasks),
        "instructions": Section("Success that depends on the instruction", world_models.instructions),
        "codes": Section("LFQ, and success by the goal frame", codes.section),
        "learning_curve": Section("Data, network size, training time", world_models.learning_curve),
        "text_dynamics": Section("Goal frames", world_models.text_dynamics),
        "ablation": Section("Keypoints and depth", world_models.ablation),
        "ablation_network": Section("Parts of the autoregressive network", world_models.ablation_network),
    },
    "Recording, algorithms, speed": {
        "planners": Section("Success of the scripted planners", speed.planners),
        "cameras": Section("What a frame of each camera tells", speed.cameras),
        "control": Section("PPO and GRPO in Gymnasium's control tasks", speed.control),
        "speed": Section("Speed on the CPU", speed.speed),
        "speed_gpu": Section("Speed and memory on a GPU", speed.speed_gpu),
        "training_memory": Section("Memory in training", speed.training_memory),
    },
}
"""Chapter → study → section."""
