"""Policies judged in a world model: the estimates, what is refused, and the command."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lerobot_wmrl.common.checkpoints import Checkpoint, model_folder
from lerobot_wmrl.common.errors import FieldError, Stopped
from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.data.dataset import ChosenEpisodes
from lerobot_wmrl.data.episodes import EpisodeTable
from lerobot_wmrl.envs.configuration_world_model import StartFrames, WorldModelEnv
from lerobot_wmrl.evaluation import policy_rollouts
from lerobot_wmrl.evaluation.calibration import Confusion
from lerobot_wmrl.evaluation.evidence import (
    LabelledRollouts,
    confusion_of,
    learnt_from,
    pooled_instructions,
    read_references,
    replayed_rollouts,
    trained_inside,
    training_folder,
)
from lerobot_wmrl.evaluation.judgement import Judgement
from lerobot_wmrl.evaluation.outcomes import Outcomes
from lerobot_wmrl.scripts.judge import JudgeConfig, even_batch, judge, main, starts_of_one_task
from tests.relabelled import relabelled
from tests.rl.checkpoints import save_untrained_policy

GOOD = Confusion(Proportion(80, 100), Proportion(20, 100))
NINE = [(38, 30 + error) for error in range(1, 10)]
"""The world model says 38 % of nine references, of which 31 to 39 % succeed in reality."""


def outcomes(successes: int, n: int = 100) -> list[bool]:
    return [True] * successes + [False] * (n - successes)


def with_references(*rates: tuple[int, int], judged: int = 50, **settings: Any) -> Judgement:
    """Return a judgement of `judged` by references that succeed so often in imagination and in reality."""
    known = {str(index): Proportion(real, 100) for index, (_, real) in enumerate(rates)}
    imagined = {str(index): outcomes(seen) for index, (seen, _) in enumerate(rates)}
    judgement = Judgement(GOOD, known, {}, 0.9, (), {"judged": outcomes(judged), **imagined})
    return replace(judgement, **settings)


def test_without_references_the_estimate_is_by_the_rollouts():
    judgement = with_references()
    assert judgement.estimate("judged") == judgement.corrected("judged").clipped()
    assert judgement.estimate("judged").value == pytest.approx(0.5)
    assert "hold if the world model errs about these policies as it does about the rollouts" in str(judgement)
    assert "too few" not in str(judgement)


def test_nine_references_give_the_estimate_and_eight_are_too_few():
    judgement = with_references(*NINE)
    estimate = judgement.estimate("judged")
    assert estimate.value == pytest.approx(0.35)
    assert 0.25 < estimate.low < 0.31 < 0.39 < estimate.high < 0.45
    assert "by a line through 9 references" in str(judgement)
    assert judgement.estimate("0") is None, "it is known"
    assert "0       38 % (38 of 100) in imagination, 31 % in reality" in str(judgement).splitlines()
    few = with_references(*NINE[:8])
    assert few.estimate("judged") == with_references().estimate("judged")
    assert "8 references are too few to do without that" in str(few)


def test_a_reference_that_is_refused_says_nothing():
    judgement = with_references(*NINE, (75, 10), refused={"9": "it was trained there"})
    assert judgement.estimate("judged") == with_references(*NINE).estimate("judged")
    assert judgement.as_json(True)["references"] == 9
    assert "75 % (75 of 100) in imagination, 10 % in reality; not judged: it was trained there" in str(
        judgement
    )


def test_a_refused_policy_has_its_reason_in_place_of_an_estimate():
    judgement = with_references(refused={"judged": "it was trained there"})
    assert judgement.estimate("judged") is None
    assert judgement.as_json(True)["policies"]["judged"] == {
        "imagined": Proportion(50, 100).as_json(),
        "estimate": None,
        "real": None,
        "refused": "it was trained there",
    }
    assert "judged  50 % (50 of 100) in imagination; not judged: it was trained there" in str(judgement)


@pytest.mark.parametrize(
    ("seen", "said"), [(5, "less often than the rollouts' failures"), (98, "more often")]
)
def test_a_policy_whose_imagined_success_no_real_rate_explains_is_refused(seen, said):
    assert said in with_references(judged=seen).refusal("judged")
    assert with_references(judged=15).refusal("judged") is None
    assert with_references(*NINE, judged=seen).estimate("judged").value == pytest.approx(0.35)


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
        ({"policies": {"a": {"k": 5, "n": 4}}}, "5 of 4 is no number"),
        ({"policies": {"a": {"k": 0, "n": 0}}}, "0 of 0 is no number"),
        ({"policies": {"a": {"k": 0.6, "n": 1}}}, "0.6 of 1 is no number"),
        ({"policies": {"a": 0.5}}, "no success of policies can be read"),
        ({"a": 1}, "no success of policies can be read"),
        ([], "no success of policies can be read"),
        ({"env": "pusht", "policies": {}}, "no success of policies can be read"),
        ({"env": {"type": "world_model"}, "policies": {}}, "its episodes are imagined ones"),
        ({"env": None, "finished": False, "policies": {}}, "the comparison was interrupted"),
        ({"finished": True, "complete": False, "policies": {}}, "the comparison stopped early"),
        ({"pairs": [{"test": "sequential"}], "policies": {}}, "the comparison may have stopped early"),
    ],
)
def test_other_references_are_refused(content, said, tmp_path):
    with pytest.raises(ValueError, match=f"^references=.*{said}"):
        read_references(write(tmp_path / "known.json", content))
    with pytest.raises(ValueError, match=r"^references=.*no success of policies can be read"):
        read_references(tmp_path / "absent.json")


@pytest.mark.parametrize(
    ("starts", "field", "remedy"),
    [
        (StartFrames(), "dataset.episodes=[0, 1]", "choose the rollouts of one of them"),
        (StartFrames(root="s"), "dataset.tasks=None", "choose one of them, and rollouts of the same task"),
    ],
)
def test_starts_of_several_tasks_are_refused(starts, field, remedy):
    config = JudgeConfig(dataset=ChosenEpisodes("d", episodes=[0, 1]), starts=starts)
    with pytest.raises(ValueError, match="the starts are of 2 tasks") as refused:
        starts_of_one_task({"imagination": {0: None, 1: None}}, config)
    assert str(refused.value).startswith(f"{field}:")
    assert str(refused.value).endswith(f"; {remedy}")


def test_starts_of_several_tasks_are_refused_by_the_flag_that_was_given(config, seeing, monkeypatch):
    def refuse(*_):
        raise FieldError("dataset.tasks", None, "of 2 tasks")

    monkeypatch.setattr("lerobot_wmrl.scripts.judge.starts_of_one_task", refuse)
    with pytest.raises(ValueError, match=r"^starts\.tasks"):
        judge(replace(config, starts=StartFrames(root=config.dataset.root)))


def test_rollouts_that_bias_the_confusion_are_warned_about():
    """Three frames of each episode; the first failure has but two, and the success holds for one frame."""
    probability = np.array([[0.1, 0.1, np.nan], [0.1, 0.9, 0.9], [0.9, 0.9, 0.9]])
    done = np.array([[False] * 3, [False] * 3, [False, False, True]])
    env = WorldModelEnv(episode_length=3, done_frames=2)
    found, warnings = confusion_of(Outcomes(np.arange(3), probability, done, held=9), env)
    assert (found.false_positives, found.recall) == (Proportion(1, 2), Proportion(1, 1))
    assert [warning.partition(" were ")[0].partition(" end ")[0] for warning in warnings] == [
        "1 of 2 failures",
        "1 of 1 successes",
    ]
    assert confusion_of(Outcomes(np.arange(2), probability[1:], done[1:], held=1), env)[1] == []


@pytest.mark.parametrize(
    ("episodes", "most", "size"), [(102, 50, 34), (160, 50, 40), (3, 50, 3), (100, 50, 50)]
)
def test_batches_are_even(episodes, most, size):
    assert even_batch(episodes, most) == size


@pytest.fixture
def config(small_dataset, trained_models, tmp_path) -> JudgeConfig:
    policies = [str(save_untrained_policy(tmp_path / name, actions=7)) for name in ("a", "b")]
    return JudgeConfig(
        policies=policies,
        world_model=Checkpoint(str(trained_models["action_world_model"])),
        dataset=ChosenEpisodes(str(small_dataset.root)),
        starts=StartFrames(max_starts=3),
        batch_size=2,
        done_threshold=0.0001,
        done_frames=1,
        episode_length=20,
        device="cpu",
        output_dir=tmp_path / "out",
    )


@pytest.fixture
def sizes(monkeypatch) -> list[int]:
    """Record how many imagined episodes run at once."""
    sizes, opened = [], policy_rollouts.opened

    def noted(env, n_envs, *others):
        sizes.append(n_envs)
        return opened(env, n_envs, *others)

    monkeypatch.setattr("lerobot_wmrl.scripts.judge.opened", noted)
    return sizes


@pytest.fixture
def seeing(monkeypatch) -> None:
    """Let the untrained world model tell successes from failures."""
    monkeypatch.setattr("lerobot_wmrl.scripts.judge.confusion_of", lambda *_: (GOOD, []))


def results_of(config: JudgeConfig) -> dict[str, Any]:
    judge(config)
    return json.loads((config.output_dir / "judgement.json").read_text())


def test_an_untrained_world_model_judges_nothing_and_leaves_the_folder_free(config):
    with pytest.raises(Stopped, match="too little to judge by"):
        judge(config)
    assert not config.output_dir.exists()


def test_every_policy_has_one_episode_from_each_start(config, seeing, capsys):
    """All are imagined successes at this threshold, none at a threshold that is out of reach."""
    found = results_of(config)
    assert found["outcomes"] == {name: [True] * 3 for name in config.policies}
    assert found["finished"]
    assert "100 % (3 of 3) in imagination; estimate: 100 %" in capsys.readouterr().out
    assert (config.output_dir / "judgement.png").is_file()
    never = replace(config, done_threshold=0.9999, output_dir=config.output_dir.with_name("never"))
    assert results_of(never)["outcomes"] == {name: [False] * 3 for name in config.policies}


def test_no_more_episodes_are_imagined_at_once_than_there_are_rollouts_to_start_in(config, seeing, sizes):
    found = results_of(replace(config, starts=StartFrames(), batch_size=50))
    assert [len(outcomes) for outcomes in found["outcomes"].values()] == [6, 6]
    assert sizes == [6]


def test_policies_references_and_coverage_may_be_added_and_what_was_imagined_is_kept(
    config, seeing, tmp_path
):
    first, second = config.policies
    config.policies = [first]
    results_of(config)
    path = config.output_dir / "judgement.json"
    stored = json.loads(path.read_text())
    earlier = {**stored["checkpoints"], "another": "0123456789ab"}
    outcomes = {first: [True, False, False], "another": [True] * 3}
    write(path, {**stored, "outcomes": outcomes, "checkpoints": earlier})
    known = write(tmp_path / "known.json", {"policies": {second: {"k": 1, "n": 2}}})
    found = results_of(replace(config, references=known, coverage=0.5))
    assert found["outcomes"] == {first: [True, False, False], second: [True] * 3, "another": [True] * 3}
    assert [*found["policies"]] == [first, second]
    assert found["finished"]
    assert found["checkpoints"].keys() == {first, second, "another"}
    assert found["policies"][second]["real"]["k"] == 1
    with pytest.raises(ValueError, match="was begun with other settings"):
        judge(replace(config, done_threshold=0.9999))


def test_a_policy_whose_actions_are_not_finite_is_named_and_the_others_are_kept(config, seeing, tmp_path):
    broken = str(save_untrained_policy(tmp_path / "broken", actions=7, constant=math.nan))
    config = replace(config, policies=[*config.policies, broken])
    with pytest.raises(ValueError, match=r"^policies=.*broken.*NaN in environments"):
        judge(config)
    stored = json.loads((config.output_dir / "judgement.json").read_text())
    assert list(stored["outcomes"]) == config.policies[:2]
    assert not stored["finished"]


def test_episodes_of_other_rollouts_or_another_world_model_are_not_mixed(config, seeing, monkeypatch):
    judge(config)
    changed = Confusion(Proportion(81, 100), Proportion(20, 100))
    monkeypatch.setattr("lerobot_wmrl.scripts.judge.confusion_of", lambda *_: (changed, []))
    with pytest.raises(ValueError, match="has changed since its episodes were imagined"):
        judge(config)


def test_another_policy_of_the_same_name_is_not_judged_by_the_first_one_s_episodes(config, seeing):
    judge(config)
    save_untrained_policy(Path(config.policies[1]), actions=7, constant=0.01)
    with pytest.raises(
        ValueError, match=f"{config.policies[1]} has changed since its episodes were imagined"
    ):
        judge(config)


def test_instructions_of_several_tasks_are_not_averaged_silently(make_synthetic_dataset, tmp_path):
    two = make_synthetic_dataset(tmp_path / "two", episodes=3, length=5, instructions=["push", "pull"])
    (warning,) = pooled_instructions(LabelledRollouts.read(ChosenEpisodes(str(two.root))))
    assert "2 instructions ('pull', 'push' …)" in warning
    assert pooled_instructions(LabelledRollouts.read(ChosenEpisodes(str(two.root)), episodes=[0, 2])) == []


def test_a_policy_is_not_also_a_reference(config, seeing, tmp_path):
    config.references = write(tmp_path / "known.json", {"policies": {config.policies[0]: {"k": 1, "n": 2}}})
    with pytest.raises(ValueError, match=r"policies=.*its real success is known"):
        judge(config)
    write(config.references, {"policies": {str(tmp_path / "nothing"): {"k": 1, "n": 2}}})
    with pytest.raises(ValueError, match=r"references=.*no checkpoint there"):
        judge(config)


def settings_of(checkpoint: str) -> Path:
    return model_folder(checkpoint) / "train_config.json"


def test_a_policy_that_was_trained_in_the_world_model_is_refused(config, seeing, trained_models):
    name, model = config.policies[0], str(trained_models["action_world_model"])
    write(settings_of(name), {"env": {"type": "world_model", "world_model_path": model}})
    found = results_of(config)["policies"]
    assert "it was trained in this world model" in found[name]["refused"]
    assert found[name]["estimate"] is None
    assert found[config.policies[1]]["refused"] is None


def test_any_checkpoint_of_the_world_model_and_any_training_before_counts(config, trained_models, tmp_path):
    """The second policy began with the first, which was trained in an earlier checkpoint of the world
    model.
    """
    (first, second), model = config.policies, str(trained_models["action_world_model"])
    earlier = min((trained_models["action_world_model"] / "checkpoints").glob("0*"))
    write(settings_of(first), {"env": {"type": "world_model", "world_model_path": str(earlier)}})
    write(settings_of(second), {"env": None, "policy": {"pretrained_path": first}})
    assert trained_inside(second, model) is not None
    write(settings_of(second), {"env": None, "policy": {"pretrained_path": second}})
    assert trained_inside(second, model) is None
    further = tmp_path / "further"
    further.mkdir()
    write(further / "train_config.json", {"model": {"pretrained_path": model}})
    write(settings_of(first), {"env": {"type": "world_model", "world_model_path": model}})
    assert trained_inside(first, str(further)) is not None, "it has learnt more since"
    dyna = training_folder(first) / "dyna" / "000002" / "action_world_model"
    dyna.mkdir(parents=True)
    write(dyna / "train_config.json", {})
    assert trained_inside(first, str(dyna)) is not None, "the training's own"
    other = str(trained_models["frame_tokenizer"])
    write(settings_of(first), {"env": {"type": "world_model", "world_model_path": other}})
    assert trained_inside(first, model) is None


def test_a_planner_in_the_world_model_is_refused(tmp_path, trained_models):
    model = str(trained_models["action_world_model"])
    planner = write(tmp_path / "config.json", {"type": "wm_mpc", "world_model_path": model})
    assert "it plans in this world model" in trained_inside(str(planner.parent), model)


def test_rollouts_that_the_world_model_has_learnt_from_are_warned_about(
    config, seeing, capsys, tmp_path, make_synthetic_dataset, small_dataset, monkeypatch
):
    (warning,) = results_of(config)["warnings"]
    assert "has learnt from" in warning
    assert warning in capsys.readouterr().out
    model = config.world_model.path
    with monkeypatch.context() as held_out:
        held_out.setattr(EpisodeTable, "validation", property(lambda table: np.arange(6) % 3 == 1))
        assert learnt_from(model, LabelledRollouts.read(config.dataset, "validation,ind")) == 0
        assert learnt_from(model, LabelledRollouts.read(config.dataset)) == 4
    others = ChosenEpisodes(str(make_synthetic_dataset(tmp_path / "others", episodes=3, length=5).root))
    assert learnt_from(model, LabelledRollouts.read(others)) == 0
    again = ChosenEpisodes(str(tmp_path / "copy"))
    shutil.copytree(small_dataset.root, again.root)
    assert learnt_from(model, LabelledRollouts.read(again)) == 6
    assert learnt_from(model, LabelledRollouts.read(again, episodes=[0, 3])) == 2
    copy = tmp_path / "parts"
    shutil.copytree(model_folder(config.world_model.path), copy)
    write(copy / "train_config.json", {"dataset": {"root": config.dataset.root, "episodes": [0, 1]}})
    assert learnt_from(str(copy), LabelledRollouts.read(config.dataset, episodes=[2, 3])) == 0
    assert learnt_from(str(copy), LabelledRollouts.read(config.dataset, episodes=[1, 2])) == 1
    write(
        copy / "train_config.json",
        {"dataset": {"root": config.dataset.root, "episodes": [0, 1], "more": [again.root]}},
    )
    assert learnt_from(str(copy), LabelledRollouts.read(config.dataset)) == 6, "as copies too"
    (tmp_path / "tokenizer").mkdir()
    write(tmp_path / "tokenizer" / "train_config.json", {"dataset": {"root": config.dataset.root}})
    of_others = {"dataset": {"root": others.root}, "model": {"tokenizer_path": str(tmp_path / "tokenizer")}}
    write(copy / "train_config.json", of_others)
    for tells_success, expected in ((False, 0), (True, 6)):
        write(tmp_path / "tokenizer" / "config.json", {"tokenizer": {"success": tells_success}})
        assert learnt_from(str(copy), LabelledRollouts.read(config.dataset)) == expected
    copy = tmp_path / "of_the_hub"
    shutil.copytree(model_folder(config.world_model.path), copy)
    write(copy / "train_config.json", {"dataset": {"repo_id": "user/rollouts"}})
    assert learnt_from(str(copy), LabelledRollouts.read(again)) == 0, "nothing is downloaded to find out"
    of_that_name = replace(LabelledRollouts.read(again), name="user/rollouts")
    assert learnt_from(str(copy), of_that_name) == 6
    monkeypatch.setattr("lerobot_wmrl.data.dataset.HF_LEROBOT_HUB_CACHE", tmp_path / "hub")
    shutil.copytree(
        small_dataset.root, tmp_path / "hub" / "datasets--user--rollouts" / "snapshots" / "c0ffee"
    )
    assert learnt_from(str(copy), LabelledRollouts.read(again)) == 6
    copy = tmp_path / "model"
    shutil.copytree(model_folder(config.world_model.path), copy)
    write(copy / "train_config.json", {"dataset": {"root": "demonstrations", "more": [others.root]}})
    assert learnt_from(str(copy), LabelledRollouts.read(others)) == 3
    (tmp_path / "further").mkdir()
    further = write(
        tmp_path / "further" / "train_config.json",
        {
            "dataset": {"root": "rollouts"},
            "model": {"pretrained_path": str(copy)},
        },
    )
    write(further.parent / "config.json", {})
    assert learnt_from(str(further.parent), LabelledRollouts.read(others)) == 3, "from the first on"
    shutil.rmtree(Path(others.root) / "data")
    assert learnt_from(str(copy), LabelledRollouts.read(again)) == 0, "what is not whole tells nothing"


def test_what_was_trained_where_is_known_in_every_folder(config, small_dataset, tmp_path, monkeypatch):
    """Commands were given paths from the folder they were called in."""
    work, model = tmp_path / "work", tmp_path / "work" / "out" / "wm"
    shutil.copytree(small_dataset.root, work / "data")
    shutil.copytree(model_folder(config.world_model.path), model)
    write(model / "train_config.json", {"dataset": {"root": "data"}, "output_dir": "out/wm"})
    (work / "out" / "policy").mkdir()
    policy = write(
        work / "out" / "policy" / "train_config.json",
        {"env": {"world_model_path": "out/wm"}, "output_dir": "out/policy"},
    ).parent
    write(policy / "config.json", {})
    write(model / "train_config.json", {"dataset": {"root": "../data"}, "output_dir": "../out/wm"})
    monkeypatch.chdir(work)
    assert learnt_from("out/wm", LabelledRollouts.read(ChosenEpisodes("data"))) == 6, "from work/somewhere"
    write(model / "train_config.json", {"dataset": {"root": "data"}, "output_dir": "out/wm"})
    for folder, prefix in ((work, ""), (work / "out", "../"), (tmp_path, "work/"), (tmp_path, f"{work}/")):
        monkeypatch.chdir(folder)
        source = ChosenEpisodes(f"{prefix}data")
        assert learnt_from(f"{prefix}out/wm", LabelledRollouts.read(source)) == 6
        assert trained_inside(f"{prefix}out/policy", f"{prefix}out/wm")


def test_rollouts_count_within_the_length_of_an_episode_and_must_both_succeed_and_fail(
    config, small_dataset, tmp_path
):
    env = config.imagination()
    every = replayed_rollouts(env, LabelledRollouts.read(config.dataset))
    assert len(every.episodes) == small_dataset.num_episodes
    assert every.probability.shape[1] <= env.horizon
    assert (
        len(replayed_rollouts(env, LabelledRollouts.read(config.dataset, "train", [0, 1, 2, 3])).episodes)
        == 4
    )
    config.episode_length = int(every.done[every.success].argmax(1).min())
    with pytest.raises(
        ValueError, match=rf"none of the \d+ rollouts succeeds within {config.episode_length} frames"
    ):
        replayed_rollouts(config.imagination(), LabelledRollouts.read(config.dataset))
    labels = [False] * small_dataset.num_frames
    failing = ChosenEpisodes(
        str(relabelled(Path(small_dataset.root), tmp_path / "f", {"next.success": labels}))
    )
    with pytest.raises(
        ValueError, match=r"dataset\.root=.*none of the \d+ rollouts succeeds within 20 frames"
    ):
        replayed_rollouts(env, LabelledRollouts.read(failing))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"policies": []}, "policies=.*nothing to judge"),
        ({"world_model": Checkpoint()}, r"world_model\.path=.*is missing"),
        ({"dataset": ChosenEpisodes()}, r"dataset\.root=.*is missing"),
        ({"coverage": 1.0}, "coverage=1.0: must be above 0 and below 1"),
        ({"batch_size": 0}, "batch_size=0: must be at least 1"),
        ({"starts": StartFrames(branches=2)}, r"starts\.branches=2: from the middle"),
        ({"starts": StartFrames(split="train")}, r"starts\.root=.*is missing"),
        ({"starts": StartFrames(root="a", resets=5)}, r"starts\.root=.*starts are given by"),
        ({"starts": StartFrames(root="a", tasks=["stir"])}, r"starts\.tasks=\['stir'\]: choose from"),
        ({"done_threshold": 1.5}, "done_threshold=1.5: must be above 0 and below 1"),
        ({"world_model": Checkpoint("/nowhere")}, r"world_model\.path=/nowhere: no action_world_model there"),
    ],
)
def test_bad_settings_are_named_before_anything_is_made(config, changes, said):
    with pytest.raises(ValueError, match=f"^{said}"):
        judge(replace(config, **changes))
    assert not config.output_dir.exists()


def test_a_policy_in_other_units_is_not_judged(config, tmp_path):
    degrees = str(save_untrained_policy(tmp_path / "degrees", actions=7, constant=1000.0))
    with pytest.raises(ValueError, match=rf"policies={degrees}: .* is 1000 on average"):
        judge(replace(config, policies=[*config.policies, degrees]))
    assert not config.output_dir.exists()


def test_starts_that_cannot_be_read_are_named_by_their_own_flag(config, seeing, monkeypatch, capsys):
    flags = {
        "policies": f"[{','.join(config.policies)}]",
        "world_model.path": config.world_model.path,
        "dataset.root": config.dataset.root,
        "starts.root": "/nowhere",
        "output_dir": config.output_dir,
        "episode_length": 20,
        "device": "cpu",
    }
    monkeypatch.setattr(
        "sys.argv", ["lerobot-wmrl-judge", *(f"--{name}={value}" for name, value in flags.items())]
    )
    with pytest.raises(SystemExit):
        main()
    assert "error: --starts.root=/nowhere: " in capsys.readouterr().err
    assert not config.output_dir.exists()
