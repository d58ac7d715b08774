"""Policies judged in a world model: the estimates, what is refused, and the command."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

from lerobot_wmrl.common.checkpoints import Checkpoint, resolve_checkpoint
from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.data.episodes import ChosenEpisodes
from lerobot_wmrl.envs.configuration_world_model import StartFrames
from lerobot_wmrl.evaluation import judgement as judging
from lerobot_wmrl.evaluation.calibration import Recognition
from lerobot_wmrl.evaluation.judgement import (
    Judgement,
    learnt_from,
    read_references,
    recognise,
    save_picture,
    trained_inside,
)
from lerobot_wmrl.scripts.judge import JudgeConfig, judge
from tests.relabelled import relabelled
from tests.rl.checkpoints import save_untrained_policy

GOOD = Recognition(Proportion(80, 100), Proportion(20, 100))


def outcomes(successes: int, n: int = 100) -> list[bool]:
    return [True] * successes + [False] * (n - successes)


def with_references(*rates: tuple[int, int], judged: int = 50, **settings) -> Judgement:
    """Return a judgement of `judged` by references that succeed so often in imagination and in reality."""
    known = {str(index): Proportion(real, 100) for index, (_, real) in enumerate(rates)}
    imagined = {str(index): outcomes(seen) for index, (seen, _) in enumerate(rates)}
    judgement = Judgement(GOOD, known, {}, 0.9, None, {"judged": outcomes(judged), **imagined})
    return replace(judgement, **settings)


def test_without_references_the_interval_is_that_of_the_rollouts():
    judgement = with_references()
    assert judgement.margin is None
    assert judgement.estimate("judged") == judgement.corrected("judged")
    assert judgement.estimate("judged").value == pytest.approx(0.5)
    assert "if it errs alike about these policies" in str(judgement)


def test_nine_references_give_the_margin_and_eight_none():
    """38 of 100 seen are 30 real ones; the references are up to nine points off."""
    rates = [(38, 30 + error) for error in range(1, 10)]
    judgement = with_references(*rates)
    assert judgement.margin == pytest.approx(0.09)
    assert judgement.estimate("judged") == pytest.approx((0.5, 0.41, 0.59))
    assert "By 9 references, 90 % of the estimates are at most 9 points" in str(judgement)
    few = with_references(*rates[:8])
    assert few.margin == math.inf
    assert few.estimate("judged")[1:] == (0, 1)
    assert "8 references are too few" in str(few)
    assert few.as_json()["margin"] is None


def test_a_reference_that_is_refused_says_nothing_about_errors():
    rates = [(38, 30 + error) for error in range(1, 10)]
    judgement = with_references(*rates, (90, 10), refused={"9": "trained there"})
    assert judgement.margin == pytest.approx(0.09)


def test_a_refused_policy_has_no_estimate_but_its_reason():
    judgement = with_references(refused={"judged": "it was trained there"})
    assert judgement.estimate("judged") is None
    assert judgement.as_json()["policies"]["judged"] == {
        "imagined": Proportion(50, 100).as_json(), "estimate": None, "real": None,
        "refused": "it was trained there",
    }  # fmt: skip
    assert "judged: not judged, it was trained there" in str(judgement)


@pytest.mark.parametrize("recall", [60, 0])
def test_a_world_model_that_hardly_sees_success_judges_nothing(recall, tmp_path):
    judgement = with_references(recognition=Recognition(Proportion(recall, 100), Proportion(20, 100)))
    assert judgement.blind
    assert judgement.estimate("judged") is None
    assert "Nothing is judged" in str(judgement)
    save_picture(judgement, tmp_path / "judgement.png")
    assert (tmp_path / "judgement.png").stat().st_size > 1000


def write(path: Path, content: object) -> Path:
    path.write_text(json.dumps(content))
    return path


def test_references_are_read_from_a_comparison_or_a_file_by_hand(tmp_path):
    path = write(tmp_path / "known.json", {"policies": {"a": {"k": 3, "n": 4}, "b": {"k": 0, "n": 2}}})
    assert read_references(path) == {"a": Proportion(3, 4), "b": Proportion(0, 2)}
    assert read_references(None) == {}


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"policies": {"a": {"k": 5, "n": 4}}}, "a succeeds in 5 of 4 episodes"),
        ({"policies": {"a": {"k": 0, "n": 0}}}, "a succeeds in 0 of 0 episodes"),
        ({"policies": {"a": 0.5}}, "no success of policies can be read"),
        ({"a": 1}, "no success of policies can be read"),
        ([], "no success of policies can be read"),
        ({"env": {"type": "world_model"}, "policies": {}}, "its episodes are imagined ones"),
    ],
)
def test_other_references_are_refused(content, said, tmp_path):
    with pytest.raises(ValueError, match=f"^references=.*{said}"):
        read_references(write(tmp_path / "known.json", content))
    with pytest.raises(ValueError, match=r"^references=.*no success of policies can be read"):
        read_references(tmp_path / "absent.json")


@pytest.fixture
def config(small_dataset, trained_models, tmp_path) -> JudgeConfig:
    policies = [str(save_untrained_policy(tmp_path / name, actions=7)) for name in ("a", "b")]
    return JudgeConfig(
        policies=policies, world_model=Checkpoint(str(trained_models["action_world_model"])),
        dataset=ChosenEpisodes(str(small_dataset.root)), starts=StartFrames(max_starts=3), batch_size=2,
        done_threshold=0.0001, done_frames=1, episode_length=20, device="cpu", output_dir=tmp_path / "out",
    )  # fmt: skip


@pytest.fixture
def seeing(monkeypatch) -> None:
    """Let the untrained world model tell successes from failures."""
    monkeypatch.setattr(judging, "recognise", lambda *_: GOOD)


def results_of(config: JudgeConfig) -> dict:
    judge(config)
    return json.loads((config.output_dir / "judgement.json").read_text())


def test_an_untrained_world_model_judges_nothing_and_imagines_nothing(config, capsys):
    found = results_of(config)
    assert "Nothing is judged" in capsys.readouterr().out
    assert found["outcomes"] == {}


def test_every_policy_has_one_episode_from_each_start(config, seeing, capsys):
    found = results_of(config)
    assert found["outcomes"] == {name: [True] * 3 for name in config.policies}
    assert all(each["estimate"]["value"] == 1 for each in found["policies"].values())
    assert "estimated 100 %" in capsys.readouterr().out
    assert (config.output_dir / "judgement.png").is_file()


def test_the_same_command_again_imagines_only_what_is_missing(config, seeing):
    first = results_of(config)
    path = config.output_dir / "judgement.json"
    name = config.policies[0]
    path.write_text(json.dumps({**first, "outcomes": {name: [False] * 3}}))
    again = results_of(config)
    assert again["outcomes"] == {name: [False] * 3, config.policies[1]: [True] * 3}
    config.done_threshold = 0.9999
    with pytest.raises(ValueError, match="holds a run with other settings"):
        judge(config)


def test_a_policy_is_not_also_a_reference(config, seeing, tmp_path):
    config.references = write(tmp_path / "known.json", {"policies": {config.policies[0]: {"k": 1, "n": 2}}})
    with pytest.raises(ValueError, match=r"policies=.*its real success is known"):
        judge(config)
    config.policies = config.policies[1:]
    found = results_of(config)
    assert [each["real"] and each["real"]["k"] for each in found["policies"].values()] == [1, None]
    config = replace(config, output_dir=tmp_path / "other")
    write(config.references, {"policies": {str(tmp_path / "nothing"): {"k": 1, "n": 2}}})
    with pytest.raises(ValueError, match=r"references=.*no checkpoint there"):
        judge(config)


def test_a_policy_that_was_trained_in_the_world_model_is_refused(config, seeing, trained_models):
    name, model = config.policies[0], str(trained_models["action_world_model"])
    settings = resolve_checkpoint(name) / "train_config.json"
    write(settings, {"env": {"type": "world_model", "world_model_path": model}})
    found = results_of(config)["policies"]
    assert "it was trained in this world model" in found[name]["refused"]
    assert found[name]["estimate"] is None
    assert found[config.policies[1]]["refused"] is None
    write(
        settings, {"env": {"type": "world_model", "world_model_path": str(trained_models["frame_tokenizer"])}}
    )
    assert trained_inside(name, model) is None
    write(settings, {"env": None})
    assert trained_inside(name, model) is None


def test_rollouts_that_the_world_model_has_learnt_from_are_warned_about(config, seeing, capsys, tmp_path):
    assert "has learnt from" in results_of(config)["warning"]
    assert "the intervals are too narrow" in capsys.readouterr().out
    assert learnt_from(config.world_model.path, config.dataset, "validation,ind") is None
    assert learnt_from(config.world_model.path, ChosenEpisodes(str(tmp_path)), "all") is None


def test_rollouts_count_within_the_length_of_an_episode_and_must_both_succeed_and_fail(
    config, small_dataset, tmp_path
):
    env = config.imagination()
    every = recognise(env, config.dataset, "all")
    assert every.recall.n + every.false_positives.n == small_dataset.num_episodes
    labels = [False] * small_dataset.num_frames
    failing = relabelled(Path(small_dataset.root), tmp_path / "failing", {"next.success": labels})
    with pytest.raises(
        ValueError, match=r"dataset\.root=.*none of the \d+ rollouts succeeds within 20 frames"
    ):
        recognise(env, ChosenEpisodes(str(failing)), "all")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"policies": []}, "policies=.*nothing to judge"),
        ({"world_model": Checkpoint()}, r"world_model\.path=.*is missing"),
        ({"dataset": ChosenEpisodes()}, r"dataset\.root=.*is missing"),
        ({"coverage": 1.0}, "coverage=1.0: must be a share"),
        ({"batch_size": 0}, "batch_size=0: must be at least 1"),
        ({"starts": StartFrames(branches=2)}, r"starts\.branches=2: from the middle"),
        ({"done_threshold": 1.5}, "done_threshold=1.5: must be a probability"),
        ({"world_model": Checkpoint("/nowhere")}, r"world_model\.path=/nowhere: no action_world_model there"),
    ],
)
def test_bad_settings_are_named_before_anything_is_made(config, changes, said):
    with pytest.raises(ValueError, match=f"^{said}"):
        judge(replace(config, **changes))
    assert not config.output_dir.exists()
