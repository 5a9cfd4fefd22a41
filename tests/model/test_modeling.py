import dataclasses

import pytest
import torch
from peft import PeftModel
from transformers.models.qwen2_5_vl.modeling_qwen2_5_vl import Qwen2_5_VisionPatchEmbed

from proprio_mllm.model.batch import Collator
from proprio_mllm.model.building import add_adapter, build_model
from proprio_mllm.model.groups import train_only


def test_switches_off_give_the_base_model_exactly(cfg, build, plain, switch):
    model, collate = build(switch(cfg, "mrope", cse=False))
    batch = collate(plain)
    core = model.core
    types = (batch.input_ids == collate.image_token).int()
    core.model.rope_deltas = None
    with torch.no_grad():
        ours = model(batch, return_logits=True)
        theirs = core(
            input_ids=batch.input_ids,
            attention_mask=batch.attention_mask,
            pixel_values=batch.images.pixel_values,
            image_grid_thw=batch.images.grid_thw,
            mm_token_type_ids=types,
            labels=batch.labels,
        )
        masked = core(  # the wrapper leaves out the mask under right padding; give it the same inputs for bit equality
            input_ids=batch.input_ids,
            pixel_values=batch.images.pixel_values,
            image_grid_thw=batch.images.grid_thw,
            position_ids=core.model.get_rope_index(
                batch.input_ids, types, batch.images.grid_thw, None, None, batch.attention_mask
            )[0],
        )
    real = batch.attention_mask.bool()
    assert torch.equal(ours.logits[real], masked.logits[real])
    torch.testing.assert_close(ours.logits[real], theirs.logits[real], atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(ours.loss, theirs.loss, atol=1e-5, rtol=1e-5)


def test_patches_are_embedded_as_qwen_does(cfg, build, plain, switch):
    model, collate = build(switch(cfg, "mrope", cse=False))
    embed, pixels = model.core.model.visual.patch_embed, collate(plain).images.pixel_values
    theirs = Qwen2_5_VisionPatchEmbed(embed_dim=embed.proj.out_channels)
    theirs.proj = embed.proj
    torch.testing.assert_close(embed(pixels), theirs(pixels), atol=1e-5, rtol=1e-4)


def test_position_ids_of_mrope_are_qwens(cfg, build, plain, switch):
    model, collate = build(switch(cfg, "mrope", cse=False))
    batch = collate(plain, padding="left")
    types = (batch.input_ids == collate.image_token).int()
    theirs, _ = model.core.model.get_rope_index(
        batch.input_ids, types, image_grid_thw=batch.images.grid_thw, attention_mask=batch.attention_mask
    )
    real = batch.attention_mask.bool()
    assert torch.equal(batch.position_ids[:, real], theirs[:, real])


@pytest.mark.parametrize("mode", ["rope_sign", "rope_sign_raw", "rope_radial"])
def test_rope_modes_change_the_logits(mode, cfg, build, examples, switch):
    base, collate = build(switch(cfg, "mrope"))
    other, collate_other = build(switch(cfg, mode))
    with torch.no_grad():
        a, b = base(collate(examples), True).logits, other(collate_other(examples), True).logits
    assert not torch.allclose(a, b)


def test_zero_heads_change_nothing_and_moved_heads_do(cfg, build, examples, switch, shake):
    plain, collate = build(switch(cfg, "mrope", cse=False))
    with_heads, _ = build(switch(cfg, "embed_sign"))
    batch = collate(examples)
    with torch.no_grad():
        before = plain(batch, True).logits
        assert torch.equal(before, with_heads(batch, True).logits)
        shake(with_heads)
        assert not torch.allclose(before, with_heads(batch, True).logits)


def test_loss_is_the_mean_over_supervised_tokens(cfg, build, examples):
    model, collate = build(cfg)
    with torch.no_grad():
        whole = model(collate(examples))
        parts = [model(collate([example])) for example in examples]
    total = sum(float(part.loss) * part.supervised for part in parts) / whole.supervised
    assert whole.supervised == sum(part.supervised for part in parts) == collate(examples).supervised
    assert float(whole.loss) == pytest.approx(total, rel=1e-5)


def test_parts_of_similar_length_have_the_loss_and_gradients_of_the_batch(cfg, build, examples):
    model, collate = build(cfg)
    rows = [*examples, *examples]
    parts = collate.in_parts(rows)
    assert [part.input_ids.shape[0] for part in parts] == [2, 2, 2]
    widths = [part.input_ids.shape[1] for part in parts]
    assert widths == sorted(widths)
    assert widths[0] < collate(rows).input_ids.shape[1]
    sums = []
    for batches in ((collate(rows),), parts):
        model.zero_grad()
        outs = [model(batch) for batch in batches]
        for out in outs:
            out.loss.backward()
        gradients = [p.grad.clone() for p in model.parameters() if p.grad is not None]
        counts = sum(out.supervised for out in outs), sum(out.correct for out in outs)
        sums.append((sum(out.loss.detach() for out in outs), counts, gradients))
    whole, split = sums
    assert whole[1] == split[1] and {part.out_of for part in parts} == {whole[1][0]}
    torch.testing.assert_close(whole[0], split[0], atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(whole[2], split[2], atol=1e-5, rtol=1e-3)
    assert len(collate.in_parts(examples[:1])) == 1
    moved = parts[0].to("meta")
    assert moved.input_ids.device.type == "meta"


def test_padding_side_does_not_matter_for_the_loss(cfg, build, examples):
    model, collate = build(cfg)
    with torch.no_grad():
        right, left = model(collate(examples, padding="right")), model(collate(examples, padding="left"))
    torch.testing.assert_close(right.loss, left.loss, atol=1e-5, rtol=1e-5)


def _open(examples):
    return [dataclasses.replace(example, messages=example.messages[:-1]) for example in examples]


def test_a_row_chooses_among_its_allowed_replies(cfg, build, examples):
    model, collate = build(cfg)
    batch = collate(_open(examples), generation=True)
    first, second = (model.processor.tokenizer.encode(text, add_special_tokens=False)[0] for text in ("a", "b"))
    pairs = [[one, other] for one, other in ((first, second), (second, first))]
    choices = [pairs if row % 2 else [[first], [first, second]] for row in range(len(batch.input_ids))]
    for seed in range(8):
        drawn = model.generate(batch, 6, 2.0, torch.Generator().manual_seed(seed), choices)
        assert all(reply in among for reply, among in zip(drawn, choices, strict=True))


def test_cached_generation_equals_full_recomputation_and_is_batch_invariant(cfg, build, examples):
    model, collate = build(cfg)
    questions = _open(examples)
    batch = collate(questions, generation=True)
    replies = model.generate(batch, max_new_tokens=6)
    for question, reply in zip(questions, replies, strict=True):
        one = collate([question], generation=True)
        assert model.generate(one, max_new_tokens=6) == [reply]
        ids, positions = one.input_ids, one.position_ids
        grown: list[int] = []
        for _ in range(6):
            step = dataclasses.replace(
                one,
                input_ids=ids,
                attention_mask=torch.ones_like(ids),
                position_ids=positions,
                labels=torch.full_like(ids, -100),
            )
            with torch.no_grad():
                logits = model(step, True).logits[0, -1].clone()
            logits[model._never] = float("-inf")
            token = int(logits.argmax())
            if token == model._end:
                break
            grown.append(token)
            ids = torch.cat([ids, torch.tensor([[token]])], dim=1)
            positions = torch.cat([positions, positions[:, :, -1:] + 1], dim=2)
        assert grown == reply


def test_image_pads_are_never_generated(cfg, build, examples):
    model, collate = build(cfg)
    pad = model.core.config.image_token_id
    with torch.no_grad():
        model.core.lm_head.weight[pad] = 100 * model.core.lm_head.weight.mean(0)  # tied: also the embedding
    batch = collate(_open(examples), generation=True)
    drawn = model.generate(batch, 8, temperature=2.0, generator=torch.Generator().manual_seed(0))
    again = model.generate(batch, 8, temperature=2.0, generator=torch.Generator().manual_seed(0))
    assert drawn == again
    assert all(pad not in row and max(row, default=0) < len(model.processor.tokenizer) for row in drawn)


def test_generate_refuses_right_padding_and_negative_temperature(cfg, build, examples):
    model, collate = build(cfg)
    with pytest.raises(ValueError, match="left padding"):
        model.generate(collate(examples, padding="right"))
    with pytest.raises(ValueError, match="temperature -1"):
        model.generate(collate(_open(examples), generation=True), temperature=-1)


def test_text_only_batch_works(cfg, build, examples):
    model, collate = build(cfg)
    messages = [dataclasses.replace(m, images=0) for m in examples[0].messages]
    out = model(collate([dataclasses.replace(examples[0], messages=tuple(messages), views=())]))
    assert out.visual is None
    assert out.loss.isfinite()


def test_half_precision_backbone_trains_with_an_adapter(cfg, build, examples):
    model, collate = build(dataclasses.replace(cfg, dtype="bfloat16"))
    assert model.table.dtype is torch.bfloat16
    add_adapter(model)
    train_only(model, ["rows", "lora", "cse"])
    model.core.activation_checkpointing_enable()
    out = model.train()(collate(examples))
    out.loss.backward()
    assert out.loss.isfinite()
    assert model.eval().generate(collate(_open(examples), generation=True), 2) is not None


def test_cse_needs_a_point_map(cfg, processor):
    model = build_model(cfg, processor)
    with pytest.raises(ValueError, match=r"cse\.enabled needs a point map"):
        type(model)(model.core, cfg, processor, model.motion_ids, None)


def test_gradients_reach_every_trainable_part(cfg, build, examples, switch, shake):
    model, _ = build(switch(cfg, "rope_sign+embed"))
    collate = Collator(model.processor, model.cfg)
    shake(model)
    model(collate(examples)).loss.backward()
    without = [n for n, p in model.named_parameters() if p.requires_grad and (p.grad is None or not p.grad.abs().sum() > 0)]
    # The key projections' biases shift every score of a query alike, which a softmax does not see.
    assert [n for n in without if not n.endswith("k_proj.bias")] == []
    assert all(not p.requires_grad for n, p in model.named_parameters() if n.startswith("point_map."))
    assert not isinstance(model.vlm, PeftModel)
