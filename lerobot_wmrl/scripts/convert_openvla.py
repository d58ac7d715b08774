"""lerobot-wmrl-convert-openvla: convert OpenVLA's checkpoints to LeRobot's format and back.

    lerobot-wmrl-convert-openvla --direction=import --source=openvla/openvla-7b --unnorm_key=bridge_orig \\
        --target=outputs/openvla
    lerobot-wmrl-convert-openvla --direction=export --source=outputs/sft --target=outputs/openvla-sft

The import gives a folder for `--policy.path` of lerobot-train, lerobot-eval and lerobot-wmrl-train. The
export takes what they write, merges adapters into the weights, and gives a folder that OpenVLA's own code
loads.
Weights keep their number format. An import followed by an export gives equal weights bit by bit.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lerobot_wmrl.common.command_line import RunConfig, run_command
from lerobot_wmrl.common.errors import FieldError, renamed, require_choice
from lerobot_wmrl.common.files import require_new, whole_folder, writing
from lerobot_wmrl.common.flags import flag_as_typed

DIRECTIONS = ("import", "export")


@dataclass
class ConvertOpenVLAConfig(RunConfig):
    """Convert a checkpoint of OpenVLA.

    Args:
        direction: `import` converts OpenVLA's format to LeRobot's, `export` LeRobot's to OpenVLA's.
        source: folder or hub id of a checkpoint. For the export also the output folder of a training.
        target: folder to write, which must be new.
        unnorm_key: for the import: name of the dataset whose statistics turn tokens into actions. Without it
            a checkpoint with the statistics of several datasets can be fine-tuned, which adds its own, but
            not run.
    """

    direction: str = ""
    source: str = ""
    target: Path | None = None
    unnorm_key: str | None = None


def convert(cfg: ConvertOpenVLAConfig) -> None:
    """Check what is asked for, then write the target folder whole or not at all."""
    require_choice(cfg, "direction", DIRECTIONS)
    if not cfg.source:
        raise FieldError("source", cfg.source, "give the checkpoint to convert")
    if cfg.target is None:
        raise FieldError("target", None, "choose a new folder")
    require_new("target", cfg.target)
    if cfg.direction == "export" and cfg.unnorm_key is not None:
        raise FieldError("unnorm_key", cfg.unnorm_key, "the export keeps all statistics; leave it out")
    write = importer(cfg.source, cfg.unnorm_key) if cfg.direction == "import" else exporter(cfg.source)
    with writing("target", cfg.target, resumes=False), whole_folder(cfg.target) as partial:
        partial.mkdir()
        write(partial)
    print(conclusion(cfg.direction, cfg.target))


def conclusion(direction: str, target: Path) -> str:
    """Say what was made and what comes next."""
    if direction == "import":
        policy = flag_as_typed("policy.path", target)
        return f"{target}: a policy of LeRobot. Next: lerobot-eval {policy} --env.type=…"
    return f"{target}: a checkpoint that OpenVLA's own code loads"


def importer(source: str, unnorm_key: str | None) -> Callable[[Path], None]:
    """Load OpenVLA's checkpoint and return a function that writes LeRobot's."""
    from lerobot_policy_openvla.modeling_openvla import OpenVLAPolicy
    from lerobot_policy_openvla.processor_openvla import make_openvla_pre_post_processors

    policy = OpenVLAPolicy.from_openvla(source, unnorm_key=unnorm_key, as_stored=True)
    processors = make_openvla_pre_post_processors(policy.config)
    policy.config.device = None  # whoever loads it chooses

    def write(folder: Path) -> None:
        for part in (policy, *processors):
            part.save_pretrained(folder)

    return write


def exporter(source: str) -> Callable[[Path], None]:
    """Load LeRobot's checkpoint and return a function that writes OpenVLA's. FieldError if it is not one."""
    from lerobot_policy_openvla.checkpoint import write_openvla
    from lerobot_policy_openvla.modeling_openvla import OpenVLAPolicy
    from lerobot_wmrl.common.policies import load_with_adapters, read_policy_config

    with renamed("policy.path", "source"):
        config = read_policy_config(source, [])
    if config.type != OpenVLAPolicy.name:
        raise FieldError("source", source, f"a policy of type {config.type}, not {OpenVLAPolicy.name}")
    if config.use_peft:
        policy = load_with_adapters(config, as_stored=True).merge_and_unload()
    else:
        policy = OpenVLAPolicy.from_pretrained(str(config.pretrained_path), config=config, as_stored=True)

    def write(folder: Path) -> None:
        weights = policy.model.state_dict()
        write_openvla(folder, weights, config.sizes, policy.files, config.norm_stats)

    return write


def main() -> None:
    """Run the console command."""
    run_command(convert, ConvertOpenVLAConfig, list)


if __name__ == "__main__":
    main()
