"""All stages on small shards: they run, skip what is current, change only what they say, and hand on a usable model."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from configs.compose import compose
from configs.schema.train import TrainConfig
from configs.validate import ConfigError, build
from data.shards import ShardError, ShardReader, ShardWriter
from proprio_mllm.evaluation.lessons import Lessons
from proprio_mllm.model.building import add_adapter, load_model, write_stored
from proprio_mllm.model.groups import train_only
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.model.tensors import read_tensors
from proprio_mllm.training import release
from proprio_mllm.training.alignment import PHASES, AlignmentObjective, groups_of
from proprio_mllm.training.pipeline import Pipeline, StageError, variant_model
from proprio_mllm.training.rollouts import DaggerRequest, RolloutRequest, read_rollouts, rollout_row
from proprio_mllm.training.sources import Demos, shard_hash
from proprio_mllm.training.stages import STAGES, selu
from proprio_mllm.training.stages.alignment import start
from proprio_mllm.training.stages.inputs import episodes_in_words, lessons_of, turns_of
from proprio_mllm.training.stages.selu import CRITIC, copy_adapter, train_adapter
from tests.training.conftest import STEPS, collect, correct


def test_current_stages_are_skipped_and_others_are_not(trained: Pipeline) -> None:
    assert trained.run("base") is None
    assert trained.run("selu") is None
    longer = dataclasses.replace(trained.cfg.pointmap, steps=5)
    changed = Pipeline(STAGES, dataclasses.replace(trained.cfg, pointmap=longer), collect)
    assert changed.key("base") == trained.key("base")
    assert changed.key("pointmap") != trained.key("pointmap")
    assert changed.key("alignment") != trained.key("alignment")
    more = dataclasses.replace(trained.cfg.practice, episodes=5)
    practised = Pipeline(STAGES, dataclasses.replace(trained.cfg, practice=more), collect)
    assert practised.key("words") == trained.key("words")
    assert practised.key("base") != trained.key("base")


def test_a_new_recipe_makes_older_output_stale(trained: Pipeline, monkeypatch: pytest.MonkeyPatch) -> None:
    before = {name: trained.key(name) for name in ("practice", "base", "tokenizer", "alignment", "selu")}
    for name, recipe in {"base": 99, "alignment": 1, "selu": 1}.items():
        monkeypatch.setattr(type(STAGES[name]), "recipe", recipe)
    changed = {name for name in before if trained.key(name) != before[name]}
    assert changed == {"base", "alignment", "selu"}


def test_a_stage_names_what_it_needs(trained: Pipeline, tmp_path: Path) -> None:
    (tmp_path / "tiny").mkdir()
    nothing = Pipeline(STAGES, dataclasses.replace(trained.cfg, output=str(tmp_path)), collect)
    with pytest.raises(ShardError, match=r"no such file.*make them with `python train.py stage=collect`"):
        nothing.run("words")
    (tmp_path / "tiny" / "data").symlink_to(trained.paths.shards("views").parent, target_is_directory=True)
    with pytest.raises(StageError, match=r"'alignment' needs the output of 'base'; run `python train.py stage=base` first"):
        nothing.run("alignment")
    ShardWriter(tmp_path / "half", "views", "h")
    with pytest.raises(ShardError, match="its producer has not finished"):
        shard_hash(tmp_path / "half")


def test_metrics_are_reported(trained: Pipeline) -> None:
    def metrics(stage: str) -> dict[str, float]:
        return json.loads((trained.paths.stage(stage) / "done.json").read_text())["metrics"]

    assert {"side_accuracy", "side_majority", "turn_exact", "held_out_exact", "base/joint/steps"} <= set(metrics("base"))
    assert {"own_steps": 8.0, "own_as_teacher": 0.5}.items() <= metrics("practice").items()
    assert metrics("pointmap")["point_median_m"] > 0.0
    assert {"clips_mpjpe_mm", "clips_hands_mm", "clips_feet_mm", "bits_per_s", "codes_used", "perplexity"} <= set(
        metrics("tokenizer")
    )
    assert {"arm_accuracy", "shift_accuracy", "turn_exact"} <= set(metrics("alignment"))


def test_own_episodes_follow_the_teachers(trained: Pipeline) -> None:
    model = trained.cfg.model
    alone, joined = Demos(trained.paths.shards("lessons"), model), lessons_of(trained, model)
    count = len(alone.motions)
    assert len(joined.motions) == count + 12
    targets = joined.reader.column("target")
    assert targets[:count] == alone.reader.column("target")
    assert targets[count:] == targets[:12]
    assert all(targets[int(i)] == "Done()" for i in joined.ends)
    assert {joined.reader[i]["episode"] for i in joined.ends} > {alone.reader[i]["episode"] for i in alone.ends}


def test_the_control_trains_without_motion(trained: Pipeline) -> None:
    cfg = dataclasses.replace(trained.cfg, variant="no_proprio")
    control = Pipeline(STAGES, cfg, collect, lessons=Lessons())
    assert control.run("alignment") is not None
    assert control.run("selu") is not None
    model = load_model(control.paths.model("selu"))
    assert not model.cfg.proprioception
    assert model.cse is None
    assert not (control.paths.model("selu") / "motion").exists()
    phases = {path.name for path in control.paths.stage("alignment").iterdir() if path.is_dir()}
    assert phases == {"text", "image", "joint", "model"}


@pytest.mark.parametrize("phase", list(PHASES))
def test_pictures_are_read_from_phase_image_on_and_motion_by_models_that_feel(trained: Pipeline, phase: str) -> None:
    drawn: dict[str, set[str]] = {}
    for variant in ("full", "no_proprio"):
        model = start(Pipeline(STAGES, dataclasses.replace(trained.cfg, variant=variant), collect, lessons=Lessons()))
        objective = AlignmentObjective(model, None, phase, trained.cfg.alignment, "test")  # type: ignore[arg-type]
        rng = np.random.default_rng(0)
        drawn[variant] = {objective.kind(rng) for _ in range(400)}
    pictured = {"body", "plan", "judge"} if phase != "text" else set[str]()
    assert drawn["no_proprio"] == {"text"} | pictured
    assert drawn["full"] > drawn["no_proprio"] | {"feel"} and ("say_image" in drawn["full"]) is bool(pictured)


def test_another_seed_of_alignment_goes_on_from_the_shared_stages(trained: Pipeline, tmp_path: Path) -> None:
    cfg = dataclasses.replace(trained.cfg, stage="alignment", seed=7, shared_seed=trained.cfg.seed)
    other = Pipeline(STAGES, cfg, collect, lessons=Lessons())
    assert other.is_current("base") and other.key("base") == trained.key("base")
    assert other.key("alignment") != trained.key("alignment")
    assert other.run("alignment") is not None and trained.is_current("alignment")
    weights = [read_tensors(p.paths.model("alignment") / "heads.safetensors") for p in (trained, other)]
    assert any(not torch.equal(weights[0][name], weights[1][name]) for name in weights[0] if name.startswith("cse"))
    assert "full-7-alignment" in {path.name for path in release.export(other, tmp_path)}
    with pytest.raises(ValueError, match="shared_seed 0 with stage=base"):
        dataclasses.replace(trained.cfg, stage="base", shared_seed=0)


def test_oracle_selu_keeps_the_success_and_relabels_the_failure(trained: Pipeline) -> None:
    metrics = json.loads((trained.paths.stage("selu") / "done.json").read_text())["metrics"]
    assert metrics["round0_critic_direct"] == 1.0
    assert metrics["round0_critic_negative"] == 1.0
    assert metrics["round0_after_precision"] == 1.0
    # The oracle accepts both: the success as it is, and the failure under what the robot did instead.
    assert metrics["round0_kept"] == 2.0
    assert metrics["round0_kept_relabelled"] == 1.0


def test_every_model_loads(trained: Pipeline) -> None:
    for stage, proprioception in (("base", False), ("alignment", True), ("selu", True)):
        model = load_model(trained.paths.model(stage))
        assert model.cfg.proprioception is proprioception
        assert model.cfg.weights is None
        assert (model.cse is not None) is proprioception


@pytest.mark.parametrize("phase", list(PHASES))
def test_the_last_phase_may_train_the_whole_language_model(trained: Pipeline, phase: str) -> None:
    cfg = trained.cfg.alignment
    own = set(groups_of(phase, dataclasses.replace(cfg, whole=True))) - set(groups_of(phase, cfg))
    assert own == ({"lm"} if phase == "joint" else set()) and groups_of(phase, cfg) == PHASES[phase].groups


@pytest.mark.parametrize("phase", list(PHASES))
def test_a_phase_changes_only_its_groups(trained: Pipeline, phase: str) -> None:
    from proprio_mllm.model.groups import group_of
    from proprio_mllm.training.alignment import AlignmentData
    from proprio_mllm.training.sources import Clips, Views

    model = start(trained)
    shards, cfg = trained.paths.shards, trained.cfg.alignment
    tokenizer = MotionTokenizer.load(trained.paths.model("tokenizer"))
    views, demos = Views(shards("views"), model.cfg), lessons_of(trained, model.cfg)
    turns, words = turns_of(trained, model, demos, tokenizer), episodes_in_words(trained, model, "test/words")
    data = AlignmentData(model, tokenizer, Clips(shards("clips")), views, demos, turns, words, cfg)
    train_only(model, PHASES[phase].groups)
    before = {name: tensor.detach().clone() for name, tensor in model.named_parameters()}
    trained.loop(AlignmentObjective(model, data, phase, cfg, "test"), cfg.joint, trained.paths.root / f"groups-{phase}")
    changed = {group_of(name) for name, tensor in model.named_parameters() if not torch.equal(tensor, before[name])}
    image = {"rows", "lora", "cse", "mpe"}
    allowed = {"text": {"rows", "lora"}, "image": image, "joint": image | {"merger"}}
    assert {"rows", "lora"} <= changed <= allowed[phase]
    assert ("cse" in changed) == (phase != "text")


def test_adapters_train_apart(trained: Pipeline) -> None:
    model = load_model(trained.paths.model("alignment"), trainable=True)
    add_adapter(model, CRITIC)
    copy_adapter(model, "default", CRITIC)
    state = dict(model.named_parameters())
    pairs = [(name, name.replace(".default", f".{CRITIC}")) for name in state if ".default" in name]
    assert pairs
    assert all(torch.equal(state[a], state[b]) for a, b in pairs)
    chosen = train_adapter(model, CRITIC)
    assert chosen
    names = [name for name, parameter in model.named_parameters() if parameter.requires_grad]
    assert all(f".{CRITIC}" in name for name in names)
    with pytest.raises(ValueError, match="no weights of adapter 'ghost'"):
        copy_adapter(model, "ghost", CRITIC)


def test_variants() -> None:
    model = build(TrainConfig, compose("train", [])).model
    assert variant_model(model, "full") == model
    assert variant_model(model, "no_mpe").mpe.mode == "mrope"
    assert variant_model(model, "no_mpe").cse.enabled
    assert not variant_model(model, "no_mpe_cse").cse.enabled
    other = dataclasses.replace(model, cse=dataclasses.replace(model.cse, frame="camera"))
    assert variant_model(other, "no_cse") == variant_model(model, "no_cse") != variant_model(other, "full")
    with pytest.raises(ValueError, match="variant 'half'; allowed: full, no_mpe, no_cse, no_mpe_cse, no_proprio"):
        variant_model(model, "half")


def test_the_same_seed_gives_the_same_weights(trained: Pipeline, shards: Path, tmp_path: Path) -> None:
    """Initial weights included: whatever was drawn before, here a number, makes no difference."""
    torch.manual_seed(12345)
    shutil.copytree(shards, tmp_path / "tiny" / "data")
    again = Pipeline(STAGES, dataclasses.replace(trained.cfg, output=str(tmp_path)), collect, "", correct, Lessons())
    for stage in ("words", "practice", "base", "pointmap", "tokenizer", "alignment"):
        again.run(stage)
        torch.rand(1)
    files = [path.relative_to(tmp_path) for path in sorted((tmp_path / "tiny").rglob("*.safetensors"))]
    assert {path.parts[2] for path in files} == {"words", "practice", "base", "pointmap", "tokenizer", "alignment"}
    for path in files:
        ours, theirs = load_file(tmp_path / path), load_file(Path(trained.cfg.output) / path)
        assert ours.keys() == theirs.keys()
        assert all(torch.equal(tensor, theirs[name]) for name, tensor in ours.items()), path


def test_the_critic_judges_unless_the_simulator_is_asked_to(
    trained: Pipeline, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    judges: list[str] = []

    class AskedError(Exception):
        pass

    def judge(name: str) -> Callable[..., None]:
        def made(*args: object) -> None:
            judges.append(name)
            raise AskedError

        return made

    shutil.copytree(trained.cfg.output, tmp_path / "run")
    for truth in ("audit", "oracle"):
        monkeypatch.setattr(selu, "ModelJudge", judge("critic"))
        monkeypatch.setattr(selu, "OracleJudge", judge("simulator"))
        settings = dataclasses.replace(trained.cfg.selu, truth=truth)
        cfg = dataclasses.replace(trained.cfg, output=str(tmp_path / "run"), selu=settings, overwrite=True)
        with pytest.raises(AskedError):
            Pipeline(STAGES, cfg, collect, "", correct, Lessons()).run("selu")
    assert judges == ["critic", "simulator"]


@pytest.mark.parametrize(("right", "counts"), [(0.5, False), (0.9, True)])
def test_a_critic_that_is_often_wrong_teaches_the_actor_nothing(
    trained: Pipeline, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, right: float, counts: bool
) -> None:
    shutil.copytree(trained.cfg.output, tmp_path / "run")
    monkeypatch.setattr(selu, "precision", lambda judge, asked: right)
    monkeypatch.setattr(selu.ModelJudge, "completed", lambda self, asked: [at == t.rollout.length for t, at, _ in asked])
    settings = dataclasses.replace(trained.cfg.selu, truth="audit", rounds=1)
    cfg = dataclasses.replace(trained.cfg, output=str(tmp_path / "run"), selu=settings, overwrite=True)
    told = Pipeline(STAGES, cfg, collect, "", correct, Lessons())
    metrics = told.run("selu")
    assert metrics is not None
    assert metrics["round0_before_held_out_precision"] == metrics["round0_after_held_out_precision"] == right
    assert (metrics["round0_kept"] > 0, metrics["round0_critic_direct"] > 0) == (counts, counts)
    before, after = (load_model(told.paths.model(stage)).state_dict() for stage in ("alignment", "selu"))
    moved = [name for name, tensor in before.items() if ".default" in name and not torch.equal(tensor, after[name])]
    assert bool(moved) is counts


@pytest.mark.parametrize(("after", "stays"), [(0.95, True), (0.6, False)])
def test_a_critic_that_learnt_to_be_wrong_is_put_back(
    trained: Pipeline, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, after: float, stays: bool
) -> None:
    shutil.copytree(trained.cfg.output, tmp_path / "run")
    found = iter((0.9, after))
    monkeypatch.setattr(selu, "precision", lambda judge, asked: next(found))
    monkeypatch.setattr(selu.ModelJudge, "completed", lambda self, asked: [at == t.rollout.length for t, at, _ in asked])
    settings = dataclasses.replace(trained.cfg.selu, truth="audit", rounds=1)
    cfg = dataclasses.replace(trained.cfg, output=str(tmp_path / "run"), selu=settings, overwrite=True)
    told = Pipeline(STAGES, cfg, collect, "", correct, Lessons())
    metrics = told.run("selu")
    assert metrics is not None and metrics["round0_kept"] > 0  # by the critic that was right more often
    began, ended = (dict(load_model(told.paths.model(stage)).named_parameters()) for stage in ("alignment", "selu"))
    moved = [name for name in began if ".default" in name and not torch.equal(began[name], ended[_critics(name)])]
    assert bool(moved) is stays


def _critics(name: str) -> str:
    return name.replace(".default", f".{CRITIC}")


def test_another_critic_is_taught_from_the_same_rollouts(trained: Pipeline, tmp_path: Path) -> None:
    shutil.copytree(trained.cfg.output, tmp_path / "run")
    first, longer = trained.cfg.selu, dataclasses.replace(trained.cfg.selu.critic, steps=9)
    found: list[str] = []

    def asked(request: RolloutRequest) -> None:
        found.append(request.config_hash)
        raise KeyboardInterrupt

    for settings in (first, dataclasses.replace(first, critic=longer), dataclasses.replace(first, temperature=0.3)):
        cfg = dataclasses.replace(trained.cfg, output=str(tmp_path / "run"), selu=settings, overwrite=True)
        with pytest.raises(KeyboardInterrupt):
            Pipeline(STAGES, cfg, asked, "", correct, Lessons()).run("selu")
    assert found[0] == found[1] != found[2]


def test_a_stage_that_is_stopped_is_not_finished(trained: Pipeline, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not even under the configuration that had finished: the folder holds something else by now."""
    shutil.copytree(trained.cfg.output, tmp_path / "run")
    cfg = dataclasses.replace(trained.cfg, output=str(tmp_path / "run"))
    longer = Pipeline(STAGES, dataclasses.replace(cfg, pointmap=dataclasses.replace(cfg.pointmap, steps=9)))
    monkeypatch.setattr(longer, "loop", _stopped)
    with pytest.raises(KeyboardInterrupt):
        longer.run("pointmap")
    with pytest.raises(StageError, match=r"run `python train\.py stage=pointmap` first"):
        Pipeline(STAGES, dataclasses.replace(cfg, overwrite=True)).run("alignment")
    assert [path.name for path in release.export(Pipeline(STAGES, cfg), tmp_path / "weights")] == ["words", "base"]


def _stopped(*_: object) -> None:
    raise KeyboardInterrupt


def test_release(trained: Pipeline, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written = release.export(trained, tmp_path)
    assert [folder.name for folder in written] == ["words", "base", "pointmap", "full"]
    about = json.loads((tmp_path / "tiny" / "full" / "provenance.json").read_text())
    assert list(about["stages"]) == ["words", "practice", "base", "pointmap", "tokenizer", "alignment", "selu"]
    assert all(stage["command"] == "python train.py stage=all" and stage["metrics"] for stage in about["stages"].values())
    assert set(about["shards"]) == {"clips", "views", "lessons", "practice"}
    assert about["physics"] == 2  # of the lessons
    ours, released = load_model(trained.paths.model("selu")), load_model(tmp_path / "tiny" / "full")
    theirs = dict(released.named_parameters())
    assert all(tensor.dtype == torch.float32 for tensor in theirs.values())
    for name, tensor in ours.named_parameters():
        if CRITIC not in name:
            torch.testing.assert_close(theirs[name], tensor, atol=1e-4, rtol=1e-3)
    assert not (tmp_path / "tiny" / "full" / "adapters" / CRITIC).exists()
    assert not (tmp_path / "tiny" / "full" / "vlm").exists()
    shutil.copytree(tmp_path / "tiny" / "full", tmp_path / "alone" / "full")
    with pytest.raises(ValueError, match="keep the two folders side by side"):
        load_model(tmp_path / "alone" / "full")
    shutil.copytree(tmp_path / "tiny" / "base", tmp_path / "alone" / "base")
    load_model(tmp_path / "alone" / "full")
    other = tmp_path / "alone" / "base" / "vlm" / "model.safetensors"
    save_file({name: tensor + 1 for name, tensor in load_file(other).items()}, other, {"format": "pt"})
    with pytest.raises(ValueError, match="is not the backbone that"):
        load_model(tmp_path / "alone" / "full")
    assert release.find_model("nowhere", tmp_path, "tiny", "full", "selu") == tmp_path / "tiny" / "full"
    assert release.find_model(trained.cfg.output, tmp_path, "tiny", "full", "selu") == trained.paths.model("selu")
    with pytest.raises(FileNotFoundError, match="no selu model of tiny \\(no_cse\\)"):
        release.find_model("nowhere", tmp_path, "tiny", "no_cse", "selu")
    assert [path.name for path in release.export(trained, tmp_path)] == ["full"], "the base model is there already"
    monkeypatch.setattr(release, "LARGEST_MB", 0.001)
    with pytest.raises(ValueError, match=r"at most 0.001 MB are released"):
        release.export(trained, tmp_path)


def test_released_parts_are_taken_and_not_trained(trained: Pipeline, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    release.export(trained, tmp_path / "weights")
    shutil.copytree(trained.paths.root / "data", tmp_path / "run" / "tiny" / "data")
    cfg = dataclasses.replace(trained.cfg, output=str(tmp_path / "run"), given=str(tmp_path / "weights"))
    pipeline = Pipeline(STAGES, cfg, collect, "", correct, Lessons())
    monkeypatch.setattr(pipeline, "loop", _stopped)
    for stage in ("words", "practice", "base", "pointmap", "tokenizer"):
        assert pipeline.key(stage) != trained.key(stage)
        assert pipeline.run(stage) is not None and pipeline.is_current(stage)
    ours, theirs = (load_model(one.paths.model("practice")).state_dict() for one in (pipeline, trained))
    for name, tensor in theirs.items():
        torch.testing.assert_close(ours[name], tensor, atol=1e-4, rtol=1e-3)
    for stage in ("pointmap", "tokenizer"):
        ours, theirs = (load_file(one.paths.model(stage) / "model.safetensors") for one in (pipeline, trained))
        for name, tensor in theirs.items():
            torch.testing.assert_close(ours[name], tensor, atol=1e-3, rtol=1e-3)
    with pytest.raises(KeyboardInterrupt):
        pipeline.run("alignment")  # is trained
    aligned = Pipeline(STAGES, dataclasses.replace(cfg, given_alignment="taken"), collect, "", correct, Lessons())
    assert aligned.run("alignment") is not None and aligned.is_current("alignment")
    taken, theirs = load_model(aligned.paths.model("alignment")), load_model(trained.paths.model("selu")).state_dict()
    assert all(torch.allclose(theirs[name], tensor, atol=1e-4, rtol=1e-3) for name, tensor in taken.state_dict().items())
    for one in (pipeline, aligned):
        assert release.export(one, tmp_path / "weights") == [], "what was taken from there keeps its provenance"
    onward = Pipeline(STAGES, dataclasses.replace(cfg, given_alignment="continued"), collect, "", correct, Lessons())
    loops: list[str] = []
    loop = onward.loop
    monkeypatch.setattr(onward, "loop", lambda objective, *rest: loops.append(objective.name) or loop(objective, *rest))
    assert onward.run("alignment") is not None and loops == ["alignment/joint"]
    learnt, theirs = load_model(onward.paths.model("alignment")), load_model(trained.paths.model("selu")).state_dict()
    moved = {name for name, tensor in learnt.state_dict().items() if not torch.allclose(theirs[name], tensor, atol=1e-3)}
    assert moved and all(any(part in name for part in ("lora", "trainable", "cse", "merger", "mpe")) for name in moved), moved
    assert [path.name for path in release.export(onward, tmp_path / "weights")] == ["full-alignment"]
    without = dataclasses.replace(onward.cfg, variant="no_mpe_cse", seed=5, shared_seed=cfg.seed, stage="alignment")
    ablation = Pipeline(STAGES, without, collect, "", correct, Lessons())
    own_loop = ablation.loop
    monkeypatch.setattr(ablation, "loop", lambda objective, *rest: loops.append(objective.name) or own_loop(objective, *rest))
    assert ablation.run("alignment") is not None and loops == 2 * ["alignment/joint"], "base was not gone back to"
    absent = Pipeline(STAGES, dataclasses.replace(without, given_alignment="taken"), collect, "", correct, Lessons())
    assert absent.given("alignment") is None, "the full model is not taken for an ablation as it is"
    ablated = load_model(onward.paths.root / "no_mpe_cse-5" / "alignment" / "model")
    assert ablated.cse is None and ablated.point_map is None and ablated.cfg.mpe.mode == "mrope"
    assert set(ablated.state_dict()) < set(theirs), "what it goes on from is the full model"
    close = [torch.allclose(theirs[name], tensor, atol=1e-3) for name, tensor in ablated.state_dict().items()]
    assert not all(close) and sum(close) > len(close) / 2
    whole = dataclasses.replace(onward.cfg, alignment=dataclasses.replace(cfg.alignment, whole=True), overwrite=True)
    assert Pipeline(STAGES, whole, collect, "", correct, Lessons()).run("alignment") is not None
    learnt = load_model(onward.paths.model("alignment")).state_dict()
    moved = {name for name, tensor in learnt.items() if not torch.allclose(theirs[name], tensor, atol=1e-3)}
    assert any("language_model.layers" in name and "lora" not in name for name in moved), moved
    with pytest.raises(ValueError, match="given_alignment=taken takes from `given`, which is not set"):
        dataclasses.replace(trained.cfg, given_alignment="taken")

    wider = dataclasses.replace(cfg.model, text=dataclasses.replace(cfg.model.text, hidden=128))
    longer = dataclasses.replace(cfg.model, motion=dataclasses.replace(cfg.model.motion, codes=64))
    for model, stage in ((wider, "words"), (longer, "tokenizer")):
        with pytest.raises(StageError, match=r"given=.* is of .*, the configuration asks for"):
            Pipeline(STAGES, dataclasses.replace(cfg, model=model), collect, "", correct, Lessons()).run(stage)
    unheard = Pipeline(STAGES, dataclasses.replace(cfg, overwrite=True), collect, "", correct, Lessons())
    monkeypatch.setattr(unheard.lessons, "words", lambda: ("zebra",))
    with pytest.raises(StageError, match=r"tiny/base is of .*without \['zebra'\]"):
        unheard.run("base")
    words = tmp_path / "weights" / "tiny" / "words"  # become others than the point map has learnt
    file = words / "vlm" / "model.safetensors"
    save_file({name: 1.5 * tensor for name, tensor in load_file(file).items()}, file, {"format": "pt"})
    write_stored(words, json.loads((words / "config.json").read_text()))
    for stage in ("words", "practice"):
        assert pipeline.run(stage) is not None
    with pytest.raises(StageError, match=r"tiny/pointmap is of .*'words': "):
        pipeline.run("pointmap")
    absent = Pipeline(STAGES, dataclasses.replace(cfg, given=str(tmp_path / "weight")), collect, "", correct, Lessons())
    with pytest.raises(StageError, match=r"weight: no folder .*such as `weights`"):
        absent.run("words")
    shutil.rmtree(tmp_path / "weights" / "tiny" / "pointmap")
    with pytest.raises(KeyboardInterrupt):
        pipeline.run("pointmap")  # is not there


def test_another_model_may_act_in_practice_and_the_words_model_is_what_is_left(trained: Pipeline, tmp_path: Path) -> None:
    release.export(trained, tmp_path / "weights")
    shutil.copytree(trained.paths.root / "data", tmp_path / "run" / "tiny" / "data")
    actors, sees = list[Path](), tmp_path / "weights" / "tiny" / "full"
    practice = dataclasses.replace(trained.cfg.practice, student=str(sees))
    cfg = dataclasses.replace(trained.cfg, output=str(tmp_path / "run"), given=str(tmp_path / "weights"), practice=practice)

    def correct_for(request: DaggerRequest, workers: int) -> None:
        actors.append(request.model)
        correct(request, workers)

    pipeline = Pipeline(STAGES, cfg, collect, "", correct_for, Lessons())
    for stage in ("words", "practice"):
        pipeline.run(stage)
    assert actors == [sees]
    assert not load_model(pipeline.paths.model("practice")).cfg.sees


def test_rollouts_refuse_the_benchmark(tmp_path: Path) -> None:
    request = RolloutRequest(tmp_path, tmp_path / "r", 2, 0, 0.7, "h")
    collect(request)
    rollouts = read_rollouts(request.folder)
    assert rollouts[0].receptacles() == ["CoffeeTable_1"]
    assert rollouts[0].view(3).image.shape == (112, 112, 3)
    with pytest.raises(ValueError, match="3 steps need 4 observations, got 0"):
        rollout_row("e", "t", "single", "k", 0, "easy", [], STEPS, True)
    row = {**rollouts[0].row, "split": "seen"}
    writer = ShardWriter(tmp_path / "leak", "rollouts", "h")
    writer.write(0, [row])
    writer.finish({})
    with pytest.raises(ValueError, match="'e0' is of split 'seen'"):
        read_rollouts(tmp_path / "leak")


@pytest.mark.parametrize("budget", ["cpu", "debug", "gpu"])
@pytest.mark.parametrize("model", ["tiny", "qwen2_5_vl_7b"])
def test_configurations_compose(budget: str, model: str) -> None:
    cfg = build(TrainConfig, compose("train", [f"budget={budget}", f"model={model}"]))
    assert cfg.model.name == model
    assert cfg.logger.wandb in ("offline", "disabled")


@pytest.mark.parametrize(
    ("override", "message"), [("stage=foo", "selu"), ("selu.truth=maybe", "oracle"), ("base.stpes=1", "joint")]
)
def test_wrong_overrides_name_what_is_allowed(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        build(TrainConfig, compose("train", [override]))


class _Counting:
    """A stage of one's own: counts the rows of the lessons."""

    name = "counting"
    needs = ("base",)
    shards = ("lessons",)
    recipe = 1

    def settings(self, pipeline: Pipeline) -> dict[str, int]:
        return {"seed": pipeline.cfg.seed}

    def run(self, pipeline: Pipeline, folder: Path, key: str) -> dict[str, float]:
        assert folder.name == "counting" and key == pipeline.key("counting")
        return {"rows": float(len(ShardReader(pipeline.paths.shards("lessons"), "demos")))}


def test_a_stage_of_ones_own_is_one_class_and_one_entry(trained: Pipeline, tmp_path: Path) -> None:
    shutil.copytree(trained.cfg.output, tmp_path / "run")
    cfg = dataclasses.replace(trained.cfg, output=str(tmp_path / "run"))
    pipeline = Pipeline({**STAGES, "counting": _Counting()}, cfg)
    assert pipeline.ancestors("counting") == ("words", "practice", "base", "counting")
    metrics = pipeline.run("counting")
    assert metrics is not None and metrics["rows"] > 0
    assert pipeline.run("counting") is None
    assert pipeline.run("base") is None
    with pytest.raises(ValueError, match=r"stage 'sleep' has no key; allowed: words, practice, .*, counting"):
        pipeline.key("sleep")
