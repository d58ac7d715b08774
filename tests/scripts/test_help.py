import draccus
import pytest

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_wmrl.demo.stages import DemoConfig
from lerobot_wmrl.scripts.convert_openvla import ConvertOpenVLAConfig
from lerobot_wmrl.scripts.eval_world_model import EvalWorldModelConfig
from lerobot_wmrl.scripts.train import TrainConfig
from lerobot_wmrl.scripts.train_world_model import TrainWorldModelConfig

CONFIGS = (
    RecordConfig, DemoConfig, EvalWorldModelConfig, TrainConfig, TrainWorldModelConfig, ConvertOpenVLAConfig,
)  # fmt: skip


@pytest.mark.parametrize("config", CONFIGS)
def test_help_explains_and_shows_no_source_code(config: type, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        draccus.parse(config, args=["--help"])
    text = capsys.readouterr().out
    assert "(default:" in text
    assert "def " not in text
    assert "default_factory" not in text
