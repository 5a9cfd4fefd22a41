"""Tokenizer, vocabulary, processor, chat, prompts, questions, collator."""

import dataclasses
import json

import numpy as np
import pytest
import torch

from interface.steps import Action, PlanStep
from proprio_mllm.model import prompts, questions
from proprio_mllm.model.batch import Collator, Example
from proprio_mllm.model.chat import Message, encode, render, to_chat
from proprio_mllm.model.processor import CHAT_TEMPLATE, ProprioProcessor, load_processor
from proprio_mllm.model.tokenizer import SPECIAL_TOKENS, train_tokenizer
from proprio_mllm.model.vocabulary import (
    MOTION_END,
    MOTION_MASK,
    MOTION_START,
    add_motion_tokens,
    motion_text,
    motion_tokens,
)


def _pieces(processor, text):
    return processor.tokenizer.convert_ids_to_tokens(processor.tokenizer(text)["input_ids"])


def test_whole_words_are_one_token_everywhere_and_the_longest_wins(processor):
    assert _pieces(processor, "Mug_1CoffeeMachine_12Pancake_2") == ["Mug", "_1", "CoffeeMachine", "_1", "2", "Pancake", "_2"]
    assert _pieces(processor, "Pick(Mug_1)") == ["Pick", "(", "Mug", "_1", ")"]
    assert _pieces(processor, "<motion_start><motion_1><motion_15>") == ["<motion_start>", "<motion_1>", "<motion_15>"]


@pytest.mark.parametrize(
    "text", ["Pick(left, Mug_1) & Place(right, Fridge_2)", "naïve\n\n ünï 日本 ", motion_text([0, None, 15])]
)
def test_text_survives_the_tokenizer(processor, text):
    ids = processor.tokenizer(text)["input_ids"]
    assert processor.tokenizer.decode(ids, skip_special_tokens=True) == text


def test_special_tokens_are_qwens_and_unbroken(processor):
    for token in SPECIAL_TOKENS:
        assert _pieces(processor, token) == [token]
    assert processor.tokenizer.eos_token == "<|im_end|>"
    assert processor.tokenizer.decode(processor.tokenizer("<|im_end|>")["input_ids"], skip_special_tokens=True) == ""


def test_action_names_are_one_token_and_markup_teaches_no_merges():
    tokenizer = train_tokenizer(["<|im_start|>ab<motion_start><motion_1>ab<|im_end|>GoTo(PlaceBoth)"] * 9, 400)
    pieces = tokenizer.convert_ids_to_tokens(tokenizer("GoToPlaceBoth ab im_start")["input_ids"])
    assert pieces == ["GoTo", "PlaceBoth", "Ġ", "ab", "Ġ", "i", "m", "_", "s", "t", "a", "r", "t"]


def test_tokenizer_arguments_are_checked():
    with pytest.raises(ValueError, match="vocab_size 100 too small"):
        train_tokenizer(["a"], 100)
    with pytest.raises(ValueError, match="whole word 'a b'"):
        train_tokenizer(["a"], 400, ["a b"])


def test_motion_vocabulary():
    tokenizer = train_tokenizer(["a"], 320)
    ids = add_motion_tokens(tokenizer, 8)
    assert tokenizer.convert_ids_to_tokens(list(ids)) == list(motion_tokens(8))
    assert add_motion_tokens(tokenizer, 8) == ids
    assert motion_text([3, 0, None])[len(MOTION_START) : -len(MOTION_END)] == f"<motion_3><motion_0>{MOTION_MASK}"
    with pytest.raises(ValueError, match="beyond 4 codes"):
        add_motion_tokens(tokenizer, 4)
    with pytest.raises(ValueError, match="codes must be positive"):
        motion_tokens(0)


def _conversation() -> tuple[Message, ...]:
    return (
        Message("system", "look"),
        Message("user", "side Mug_1", images=1),
        Message("assistant", "left"),
        Message("user", "height Mug_1"),
        Message("assistant", "low", supervised=False),
    )


def test_template_and_rendering_agree(processor):
    for messages in (_conversation(), _conversation()[1:3]):
        text = processor.apply_chat_template(to_chat(messages), tokenize=False)
        default = "" if messages[0].role == "system" else "<|im_start|>system\nYou are a helpful assistant.<|im_end|>\n"
        assert text == default + render(messages)
    opened = processor.apply_chat_template(to_chat(_conversation()), tokenize=False, add_generation_prompt=True)
    assert opened == render(_conversation(), generation=True)


def test_piecewise_encoding_equals_the_whole_and_only_answers_are_targets(processor):
    encoded = encode(processor.tokenizer, _conversation(), generation=True)
    assert list(encoded.ids) == processor.tokenizer(render(_conversation(), generation=True))["input_ids"]
    taught = [i for i, target in zip(encoded.ids, encoded.targets, strict=True) if target]
    assert processor.tokenizer.decode(taught) == "left<|im_end|>"


def test_messages_are_checked():
    with pytest.raises(ValueError, match="role 'tool'"):
        Message("tool", "x")
    with pytest.raises(ValueError, match="only user messages"):
        Message("assistant", "x", images=1)


def test_processor_expands_the_pad_as_the_collator_does(cfg, processor, examples):
    messages, view = examples[0].messages, examples[0].views[0]
    theirs = processor(text=[render(messages)], images=[view.image], return_tensors="pt")
    ours = Collator(processor, cfg)([examples[0]])
    assert torch.equal(theirs["input_ids"], ours.input_ids)
    assert torch.equal(theirs["pixel_values"], ours.images.pixel_values)
    assert ours.images.grid == (4, 4)
    assert int((ours.input_ids == processor.image_token_id).sum()) == 16


def test_processor_loads_the_legacy_layout(processor, tmp_path):
    processor.tokenizer.chat_template = CHAT_TEMPLATE
    processor.tokenizer.save_pretrained(tmp_path)
    processor.tokenizer.chat_template = None
    legacy = {"image_processor_type": "Qwen2VLImageProcessor", "processor_class": "Qwen2_5_VLProcessor"}
    numbers = {"min_pixels": 3136, "max_pixels": 12845056, "patch_size": 14, "temporal_patch_size": 2, "merge_size": 2}
    (tmp_path / "preprocessor_config.json").write_text(json.dumps({**legacy, **numbers}))
    loaded = load_processor(tmp_path, 504)
    assert loaded.chat_template == CHAT_TEMPLATE
    image = np.zeros((500, 500, 3), dtype=np.uint8)
    assert loaded.images([image])["image_grid_thw"].tolist() == [[1, 36, 36]]
    with pytest.raises(ValueError, match="needs a tokenizer"):
        ProprioProcessor()


def test_full_prompts_say_the_same():
    text = prompts.self_ask_prompt("open", ["Mug_1"], [], [1], "full")[1].text
    for part in ("Mug_1", "<motion_1>", "nothing yet"):
        assert part in text
    assert "which open?" in prompts.self_ask_prompt("open", [], [])[1].text
    assert "are open?" in prompts.self_ask_prompt("open", [], [], style="full")[1].text
    assert prompts.answers([]) == "none"
    assert prompts.answers(["A_1", "B_1"]) == "A_1, B_1"
    with pytest.raises(ValueError, match="style 'loud'"):
        prompts.self_ask_prompt("x", [], [], style="loud")


def test_packed_questions_and_motion_exercises(cfg, processor, examples):
    packed = prompts.looking([("side Mug_1", "left"), ("height Mug_1", "")], [1])
    assert [m.role for m in packed] == ["system", "user", "assistant", "user"]
    assert [m.images for m in packed] == [0, 1, 0, 0]
    with pytest.raises(ValueError, match="at least one question"):
        prompts.looking([])
    collate = Collator(processor, cfg)
    for messages in (
        prompts.described_motion([1, 2], "a wave"),
        prompts.made_motion("a wave", [1, 2]),
        prompts.filled_motion([1, None], [1, 2]),
        prompts.described_motion([1], "x", style="full"),
    ):
        assert collate([Example(messages)]).supervised > 0
    with_image = prompts.described_motion([1, 2], "a wave", image=True)
    assert collate([Example(with_image, examples[0].views)]).images is not None


def test_what_the_body_feels_is_asked_without_an_image() -> None:
    asked = prompts.body_state_prompt([1, 2], "", "")
    assert [message.role for message in asked] == ["system", "user"]
    whole = prompts.body_state_prompt([1, 2], "left right", "0.85")
    assert [message.text for message in whole if message.role == "assistant"] == ["left right", "0.85"]
    assert whole[:2] == asked
    assert prompts.body_state_prompt([1, 2], "left right", "")[-1].role == "user"
    assert not any(message.images for message in whole)
    assert "hands" in prompts.body_state_prompt([1], "", "", style="full")[-1].text


def test_plan_steps_survive_the_model_text(processor):
    step = PlanStep((Action.parse("Pick(left, Mug_1)"), Action.parse("Place(right, Fridge_1)")))
    ids = processor.tokenizer(step.to_text())["input_ids"]
    assert PlanStep.parse(processor.tokenizer.decode(ids, skip_special_tokens=True)) == step


def test_grounding_answers_by_hand():
    assert [questions.side_answer(np.array([1.0, y, 0])) for y in (0.1, 0.3, -0.3)] == ["ahead", "left", "right"]
    assert questions.side_answer(np.array([-1.0, 0.0, 0])) == "left"
    assert [questions.distance_answer(np.array([x, 0.0, 5])) for x in (0.9, 1.5, 2.5)] == ["near", "middle", "far"]
    assert [questions.height_answer(np.array([1.0, 0, z])) for z in (-0.3, 0.0, 0.4)] == ["low", "level", "high"]
    assert [questions.arm_answer(np.array([1.0, y, 0])) for y in (0.2, 0.0, -0.2)] == ["left", "either", "right"]
    assert questions.ask("side", "Mug_1") == "side Mug_1"
    assert "Mug_1" in questions.ask("shift", "Mug_1", "full")
    with pytest.raises(ValueError, match="question 'colour'"):
        questions.ask("colour", "Mug_1")


def test_body_shift_by_hand():
    bodies = np.zeros((14, 3))
    for side, y in ((2, 0.2), (5, -0.2)):  # shoulders at 0.5 m, arms of 0.6 m hanging down
        bodies[side] = [0, y, 0.5]
        bodies[side + 1] = [0, y, 0.2]
        bodies[side + 2] = [0, y, -0.1]
    assert questions.body_shift_m(np.array([1.0, 0, 0.24]), bodies) == 0.0  # hands work at 0.2 m
    assert questions.body_shift_m(np.array([1.0, 0, -0.12]), bodies) == pytest.approx(-0.3)
    assert questions.shift_answer(np.array([1.0, 0, -0.12]), bodies) == "MoveDown(0.3)"
    assert questions.shift_answer(np.array([1.0, 0, 0.28]), bodies) == "MoveUp(0.1)"
    assert questions.shift_answer(np.array([1.0, 0, 0.16]), bodies) == "none"
    assert questions.shift_answer(np.array([1.0, 0, -9.0]), bodies) == "MoveDown(1)"


def test_an_arm_reaches_as_far_as_it_is_long_and_a_tenth_more():
    bodies = np.zeros((14, 3))
    for side, y in ((2, 0.2), (5, -0.2)):  # arms of 0.6 m, from shoulders at 0.5 m
        bodies[side], bodies[side + 1], bodies[side + 2] = [0, y, 0.5], [0, y, 0.2], [0, y, -0.1]
    answers = {
        "both": (0.6, 0.0, 0.5),
        "left": (0.6, 0.3, 0.5),
        "right": (0.6, -0.3, 0.5),
        "none": (0.7, 0.0, 0.5),
    }
    assert {name: questions.reach_answer(np.array(at), bodies) for name, at in answers.items()} == {one: one for one in answers}
    assert questions.reach_answer(np.array([0.5, 0.0, 0.0]), bodies) == "none"  # too low


def test_collator_refuses_what_does_not_fit(cfg, processor, examples):
    collate = Collator(processor, cfg, max_tokens=60)
    with pytest.raises(ValueError, match="at most 60"):
        collate(examples)
    collate = Collator(processor, cfg)
    with pytest.raises(ValueError, match="no examples"):
        collate([])
    with pytest.raises(ValueError, match="no views"):
        collate.images([])
    with pytest.raises(ValueError, match="names 1 images, but it has 2 views"):
        collate([dataclasses.replace(examples[0], views=examples[0].views * 2)])
    with pytest.raises(ValueError, match="left padding, got 'right'"):
        collate(examples, generation=True, padding="right")
    small = dataclasses.replace(examples[0].views[0], image=np.zeros((56, 56, 3), dtype=np.uint8))
    with pytest.raises(ValueError, match="of one size"):
        collate.images([small, examples[0].views[0]])
    with pytest.raises(ValueError, match="uint8"):
        collate.images([dataclasses.replace(small, image=np.zeros((56, 56, 3)))])


def test_batches_move_and_keep_their_shape(cfg, processor, examples):
    batch = Collator(processor, cfg)(examples)
    moved = batch.to("cpu")
    assert torch.equal(moved.input_ids, batch.input_ids)
    assert moved.images.grid == batch.images.grid
    assert batch.position_ids.shape == (3, *batch.input_ids.shape)
    plain = dataclasses.replace(examples[0].views[0], camera=None)
    images = Collator(processor, cfg).images([plain, examples[1].views[0]])
    assert images.camera_in_pelvis is None
    assert images.centroids[0] is None
    assert images.centroids[1] is not None
