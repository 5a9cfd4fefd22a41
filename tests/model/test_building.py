import copy
import dataclasses
import json

import pytest
import torch

from configs.schema.model import ModelConfig
from configs.validate import ConfigError, build
from proprio_mllm.model import building
from proprio_mllm.model.groups import GROUPS, adapter_of, parameter_groups, train_only
from proprio_mllm.model.motion_tokenizer import MotionTokenizer


def _logits(model, batch):
    with torch.no_grad():
        return model(batch, True).logits


@pytest.mark.parametrize("name", ["default", "actor"])
def test_round_trip_with_adapters_and_motion(name, cfg, build, examples, shake, tmp_path):
    model, collate = build(cfg)
    building.add_adapter(model, name)
    building.add_adapter(model, "critic")
    shake(model)
    building.use_adapter(model, name)
    batch = collate(examples)
    first = _logits(model, batch)
    building.use_adapter(model, "critic")
    second = _logits(model, batch)
    assert not torch.allclose(first, second)
    motion = MotionTokenizer(cfg.motion)
    building.save_model(model, tmp_path / "m", motion)
    building.save_model(model, tmp_path / "m", motion)  # replaces
    assert not list(tmp_path.glob("*.tmp"))
    assert {p.suffix for p in (tmp_path / "m").rglob("*") if p.is_file()} <= {".json", ".safetensors", ".jinja", ".txt"}
    loaded = building.load_model(tmp_path / "m", adapter=name)
    assert loaded.cfg == cfg
    assert torch.equal(_logits(loaded, batch), first)
    building.use_adapter(loaded, "critic")
    assert torch.equal(_logits(loaded, batch), second)
    assert building.load_motion(tmp_path / "m").cfg == cfg.motion


def test_round_trip_without_adapters_and_tokenizer(cfg, build, examples, shake, tmp_path):
    model, collate = build(cfg)
    shake(model)
    building.save_model(model, tmp_path / "m")
    loaded = building.load_model(tmp_path / "m")
    batch = collate(examples)
    assert torch.equal(_logits(loaded, batch), _logits(model, batch))
    assert building.load_motion(tmp_path / "m") is None
    text = "see Mug_1Pan_2<motion_3>"
    assert loaded.processor.tokenizer(text)["input_ids"] == model.processor.tokenizer(text)["input_ids"]
    assert loaded.processor.image_processor.size == model.processor.image_processor.size


def test_same_seed_same_weights(cfg, processor):
    a, b = (building.build_model(cfg, processor, seed=5) for _ in range(2))
    assert all(torch.equal(x, y) for x, y in zip(a.state_dict().values(), b.state_dict().values(), strict=True))


def test_load_refuses_an_unknown_format(cfg, build, tmp_path):
    model, _ = build(cfg)
    building.save_model(model, tmp_path / "m")
    path = tmp_path / "m" / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "format": 99}))
    with pytest.raises(ValueError, match="format 99"):
        building.load_model(tmp_path / "m")


def test_adapter_names_are_checked(cfg, build):
    model, _ = build(cfg)
    with pytest.raises(ValueError, match="no adapter 'x'; present: none"):
        building.use_adapter(model, "x")
    building.add_adapter(model, "actor")
    with pytest.raises(ValueError, match="'actor' exists"):
        building.add_adapter(model, "actor")
    with pytest.raises(ValueError, match="present: actor"):
        building.use_adapter(model, "x")


def test_processor_needs_texts(cfg):
    with pytest.raises(ValueError, match="texts are needed"):
        building.build_processor(cfg)


def test_every_trainable_parameter_is_in_one_group(cfg, build, switch):
    model, _ = build(switch(cfg, "rope_sign+embed"))
    groups = parameter_groups(model)
    assert tuple(groups) == GROUPS
    names = [name for group in groups.values() for name in group]
    assert sorted(names) == sorted(name for name, _ in model.named_parameters())
    assert all(groups[g] for g in GROUPS if g != "lora")
    building.add_adapter(model, "actor")
    groups = parameter_groups(model)
    assert groups["lora"]
    assert all("trainable_tokens_" in name for name in groups["rows"])


@pytest.mark.parametrize("chosen", [["rows", "lora"], ["rows", "cse"], ["merger", "cse", "mpe"], ["vision"], ["lm"]])
def test_only_the_named_groups_change(chosen, cfg, build, examples, switch, shake):
    model, collate = build(switch(cfg, "rope_sign+embed"))
    building.add_adapter(model, "actor")
    shake(model)
    parameters = train_only(model, chosen)
    before = {name: parameter.detach().clone() for name, parameter in model.named_parameters()}
    optimiser = torch.optim.AdamW(parameters, lr=1e-2, weight_decay=0.1)
    model(collate(examples)).loss.backward()
    optimiser.step()
    groups = parameter_groups(model)
    allowed = {name for group in chosen for name in groups[group]}
    changed = {name for name, parameter in model.named_parameters() if not torch.equal(before[name], parameter)}
    assert changed
    assert changed <= allowed
    assert {next(g for g in chosen if name in groups[g]) for name in changed} == set(chosen)


def test_inactive_adapters_do_not_train(cfg, build):
    model, _ = build(cfg)
    building.add_adapter(model, "actor")
    building.add_adapter(model, "critic")
    train_only(model, ["rows", "lora"])
    trained = {adapter_of(name) for name, parameter in model.named_parameters() if parameter.requires_grad}
    assert trained == {"critic"}


def test_an_adapter_can_start_from_another_and_merging_keeps_the_function(cfg, build, examples, shake):
    model, collate = build(cfg)
    with pytest.raises(ValueError, match="no adapter to merge"):
        building.merge_adapter(model)
    building.add_adapter(model, "stage2")
    shake(model)
    batch = collate(examples)
    first = _logits(model, batch)
    building.add_adapter(model, "actor", start="stage2")
    assert torch.equal(_logits(model, batch), first)
    building.merge_adapter(model)
    torch.testing.assert_close(_logits(model, batch), first, atol=1e-4, rtol=1e-4)
    assert not any(adapter_of(name) for name, _ in model.named_parameters())
    assert parameter_groups(model)["lm"]


@pytest.mark.parametrize("pretrained", [True, False])
def test_going_back_is_part_of_the_way_from_what_was_learnt_to_what_was(pretrained, cfg, build, shake):
    before, model = build(cfg)[0], build(cfg)[0]
    if not pretrained:  # otherwise only the adapter has learnt
        torch.manual_seed(0)
        with torch.no_grad():
            for weights in model.parameters():
                weights.add_(0.1 * torch.randn_like(weights))
    building.add_adapter(model)
    shake(model)

    def merged(one):
        one = copy.deepcopy(one)
        building.merge_adapter(one)
        return dict(one.core.named_parameters())

    learnt, was, moved = merged(model), dict(before.core.named_parameters()), 0
    building.go_back(model, None if pretrained else before, 0.25)
    for name, weights in merged(model).items():
        layers = "language_model." in name and "embed_tokens" not in name
        torch.testing.assert_close(weights, torch.lerp(learnt[name], was[name], 0.25) if layers else learnt[name])
        moved += layers and not torch.equal(weights, learnt[name])
    assert moved > 5


def test_unknown_and_empty_groups_are_refused(cfg, build):
    model, _ = build(cfg)
    with pytest.raises(ValueError, match=r"unknown parameter groups \['text'\]"):
        train_only(model, ["text"])
    with pytest.raises(ValueError, match=r"\['lora'\] hold no parameter"):
        train_only(model, ["lora"])


def test_spare_rows_are_never_cut(cfg, build):
    model, _ = build(cfg)
    rows = model.table.shape[0]
    building._extend(model.core, 10)
    assert model.table.shape[0] == rows
    building._extend(model.core, rows + 1)
    assert model.table.shape[0] == rows + 64


def test_released_weights_take_the_same_path(cfg, build, examples, tmp_path):
    """A folder in the layout of released weights (untied, motion tokens unknown) loads, adapts, saves and reloads."""
    model, collate = build(cfg)
    model.core.config.save_pretrained(tmp_path / "base")
    model.core.save_pretrained(tmp_path / "base")
    model.processor.save_pretrained(str(tmp_path / "base"))
    released = dataclasses.replace(cfg, weights=str(tmp_path / "base"))
    processor = building.build_processor(released)
    other = building.build_model(released, processor).eval()
    batch = collate(examples)
    with torch.no_grad():
        other.cse.load_state_dict(model.cse.state_dict())
        other.point_map.load_state_dict(model.point_map.state_dict())
    assert torch.equal(_logits(other, batch), _logits(model, batch))
    building.add_adapter(other)
    train_only(other, ["merger"])
    with torch.no_grad():
        for parameter in parameter_groups(other)["merger"].values():
            parameter.add_(0.1)
    building.save_model(other, tmp_path / "m")
    assert not (tmp_path / "m" / "vlm").exists()
    loaded = building.load_model(tmp_path / "m")
    assert torch.equal(_logits(loaded, batch), _logits(other, batch))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"mpe": {"mode": "sign"}}, "mpe.mode: 'sign' is not allowed"),
        ({"image_size": 100}, "image_size 100"),
        ({"point_map": {"encoder": "none"}}, "'none' is not allowed"),
        ({"point_map": {"encoder": "oracle"}}, "allowed: points"),
        ({"text": {"hidden": 100}}, "hidden 100"),
        ({"text": {"kv_heads": 3}}, "kv_heads 3"),
        ({"text": {"hidden": 64, "heads": 8}}, "head size 8"),
        ({"vision": {"hidden": 100}}, "hidden 100"),
        ({"lora": {"rank": 0}}, "rank 0"),
        ({"lora": {"dropout": 1.0}}, "dropout 1.0"),
        ({"motion": {"codes": 0}}, "codes 0"),
        ({"motion": {"window": 63}}, "window 63"),
    ],
)
def test_wrong_configurations_are_refused(values, message):
    with pytest.raises(ConfigError, match=message.replace(".", r"\.")):
        build(ModelConfig, {"name": "x", **values})
