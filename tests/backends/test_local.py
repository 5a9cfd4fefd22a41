"""A checkpoint in this process: replies, batches, threads, cuts, draws and errors, for both architectures."""

from __future__ import annotations

import dataclasses
import io
import json
import logging
import shutil
import threading
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from transformers import AutoModelForImageTextToText

from proprio_mllm.backends import local
from proprio_mllm.backends.checkpoint import load_chat_processor
from proprio_mllm.backends.identity import identity_of
from proprio_mllm.backends.local import LocalChat, encode, open_picture
from proprio_mllm.backends.protocol import Backend, BackendError, ChatImage, ChatMessage, ChatReply, ChatRequest, RequestError
from proprio_mllm.model.batch import Collator, Example, View
from proprio_mllm.model.building import load_model
from proprio_mllm.model.prompts import looking
from tests.backends.checkpoints import local_config

Ask = Callable[..., ChatRequest]
Look = Callable[..., ChatImage]
Open = Callable[..., LocalChat]
TINY = Path(__file__).parents[2] / "weights" / "tiny" / "base"


def told(reply: ChatReply) -> tuple[object, ...]:
    """What of a reply depends on the request."""
    return reply.text, reply.prompt_tokens, reply.completion_tokens, reply.finish_reason, reply.model


def several(ask: Ask, view: Look, **fields: Any) -> list[ChatRequest]:
    """Requests of different lengths, with no picture, one, and two."""
    return [
        ask("what do you see", **fields),
        ask(view(1), "open the fridge", **fields),
        ask("a", **fields),
        ask(view(2, 300), "and", view(3, 120, "jpeg"), "which is larger? " * 4, **fields),
        ask(view(4), "open the fridge", **fields),
        ask("pick the mug " * 9, **fields),
    ]


def test_a_chat_is_a_backend_and_names_itself(folder: Path, open_chat: Open) -> None:
    chat = open_chat(folder)
    assert isinstance(chat, Backend)
    name, revision = chat.model.split("@")
    assert name == folder.name
    assert len(revision) == 16
    asked = local_config(folder, revision=chat.model.partition("@")[2])
    assert chat.identity == identity_of(asked)  # so that recorded replies are found again
    named = local_config(folder, revision="abc", dtype="bfloat16")
    assert open_chat(folder, revision="abc", dtype="bfloat16").identity == identity_of(named)


def test_a_reply_is_the_naive_greedy_continuation(folder: Path, open_chat: Open, ask: Ask, view: Look) -> None:
    """Token by token over the whole sequence, without cache, batch, padding or `generate`."""
    model: Any = AutoModelForImageTextToText.from_pretrained(str(folder), dtype=torch.float32)
    model = model.eval()
    processor = load_chat_processor(folder, model.config.model_type)
    chat = open_chat(folder)
    for request in several(ask, view, max_tokens=6)[:4]:
        inputs = dict(encode(processor, request, 4096).inputs)
        ids: list[int] = []
        for _ in range(6):
            with torch.no_grad():
                token = int(model(**inputs).logits[0, -1].argmax())
            ids.append(token)
            more = {"input_ids": token, "attention_mask": 1, "mm_token_type_ids": 0}
            for name, value in more.items():
                if name in inputs:
                    inputs[name] = torch.cat([inputs[name], torch.tensor([[value]])], dim=1)
        reply = chat.complete(request)
        assert reply.text == processor.tokenizer.decode(ids, skip_special_tokens=True)
        assert reply.prompt_tokens == inputs["input_ids"].shape[1] - 6
        assert (reply.completion_tokens, reply.finish_reason) == (6, "length")
        assert reply.latency_s > 0.0


def test_rows_of_a_batch_reply_as_alone(folder: Path, open_chat: Open, ask: Ask, view: Look) -> None:
    requests = several(ask, view) + several(ask, view, temperature=1.0) + several(ask, view, max_tokens=3)
    alone = open_chat(folder, batch=1)
    expected = [told(alone.complete(request)) for request in requests]
    assert alone.batches == len(requests)
    assert len({texts[0] for texts in expected}) > len(requests) // 2, "the replies do not depend on what was asked"
    chat = open_chat(folder, batch=32)
    context, encoded = chat.context, chat._open().processor
    rows = [encode(encoded, request, context) for request in requests]
    replies = [reply for reply in chat._answer(rows) if isinstance(reply, ChatReply)]
    assert [told(reply)[:4] for reply in replies] == [one[:4] for one in expected]


def test_threads_share_batches(folder: Path, open_chat: Open, ask: Ask, view: Look, monkeypatch: pytest.MonkeyPatch) -> None:
    """While the first call is under way the others gather; then they are answered three together."""
    chat = open_chat(folder, batch=3)
    requests = several(ask, view)
    expected = [told(chat.complete(request)) for request in requests]
    before, generate = chat.batches, chat._generate
    entered, go = threading.Event(), threading.Event()

    def held(loaded: Any, rows: Any) -> list[ChatReply]:
        entered.set()
        assert go.wait(30)
        return generate(loaded, rows)

    monkeypatch.setattr(chat, "_generate", held)
    with ThreadPoolExecutor(6) as pool:
        first = pool.submit(chat.complete, requests[0])
        assert entered.wait(30)
        others = [pool.submit(chat.complete, request) for request in requests[1:]]
        while len(chat._batcher._waiting) < 5:
            threading.Event().wait(0.01)
        go.set()
        assert [told(one.result(60)) for one in (first, *others)] == expected
    assert chat.batches - before == 3  # one, then three, then two


def test_draws_depend_on_the_request_alone(folder: Path, open_chat: Open, ask: Ask) -> None:
    chat = open_chat(folder)
    texts = [chat.complete(ask("look", temperature=1.5, sample=sample)).text for sample in (0, 1, 2, 0)]
    assert texts[0] == texts[3]
    assert len(set(texts)) == 3
    greedy = [chat.complete(ask("look", sample=sample)).text for sample in (0, 1)]
    assert greedy[0] == greedy[1]
    assert chat.complete(ask("look", temperature=1e-3)).text == greedy[0]


def test_nothing_warns(folder: Path, open_chat: Open, ask: Ask, view: Look, caplog: pytest.LogCaptureFixture) -> None:
    with warnings.catch_warnings(), caplog.at_level(logging.WARNING):
        warnings.simplefilter("error")
        chat = open_chat(folder)
        for temperature in (0.0, 1.0):
            chat.complete(ask(view(1), "look", temperature=temperature))
    assert not caplog.records


def test_a_reply_ends_at_the_token_that_the_checkpoint_names(
    folder: Path, tmp_path: Path, open_chat: Open, ask: Ask, view: Look
) -> None:
    loaded = open_chat(folder)._open()
    firsts: dict[int, ChatRequest] = {}
    for request in several(ask, view):
        row = encode(loaded.processor, request, 4096)
        ids = loaded.model.generate(**row.inputs, max_new_tokens=10)[0, row.prompt :].tolist()
        firsts |= {index: request for index in range(10) if ids[index] not in ids[:index]}
    at, request = max(firsts.items())  # the latest token that is new in its reply
    row = encode(loaded.processor, request, 4096)
    end = loaded.model.generate(**row.inputs, max_new_tokens=10)[0, row.prompt + at].item()
    assert at > 0
    other = shutil.copytree(folder, tmp_path / "other")
    (other / "generation_config.json").write_text(json.dumps({"eos_token_id": [end]}), encoding="utf-8")
    reply = open_chat(other).complete(request)
    assert (reply.completion_tokens, reply.finish_reason) == (at + 1, "stop")
    exact = open_chat(other).complete(dataclasses.replace(request, max_tokens=at + 1))
    assert (exact.completion_tokens, exact.finish_reason) == (at + 1, "stop")
    cut = open_chat(other).complete(dataclasses.replace(request, max_tokens=at))
    assert (cut.completion_tokens, cut.finish_reason) == (at, "length")


def test_the_context_bounds_prompt_and_reply(folder: Path, open_chat: Open, ask: Ask) -> None:
    chat = open_chat(folder)
    assert chat.context == 1024
    few, more = (chat.complete(ask("x " * words, max_tokens=1)).prompt_tokens for words in (10, 11))
    words = 10 + (1024 - 3 - few) // (more - few)
    reply = chat.complete(ask("x " * words, max_tokens=4000))
    assert 1018 < reply.prompt_tokens < 1024
    assert (reply.completion_tokens, reply.finish_reason) == (1024 - reply.prompt_tokens, "length")
    with pytest.raises(RequestError, match=r"prompt of 10\d\d tokens; the model's context of 1024 leaves no room"):
        chat.complete(ask("x " * (words + 3)))


def test_pictures_of_500_pixels_become_patches_and_tiles(
    qwen_folder: Path, internvl_folder: Path, open_chat: Open, ask: Ask, view: Look
) -> None:
    chat = open_chat(qwen_folder)
    row = encode(chat._open().processor, ask(view(1), "look"), 4096)
    assert row.inputs["image_grid_thw"].tolist() == [[1, 36, 36]]  # 504 pixels of 14 a side
    assert row.prompt - chat.complete(ask("look")).prompt_tokens == 18 * 18 + 2
    chat = open_chat(internvl_folder)
    row = encode(chat._open().processor, ask(view(1), "look"), 4096)
    assert row.inputs["pixel_values"].shape == (10, 3, 224, 224)  # three by three and the whole
    assert row.prompt - chat.complete(ask("look")).prompt_tokens == 10 * 16 + 2 + 1


def test_a_start_token_stands_once_and_first(qwen_folder: Path, internvl_folder: Path, open_chat: Open, ask: Ask) -> None:
    """InternVL2.5's tokenizer puts it there, not its template; Qwen has none."""
    written: list[str] = []
    for folder in (qwen_folder, internvl_folder):
        tokenizer = (processor := open_chat(folder)._open().processor).tokenizer
        ids = encode(processor, ask("look"), 4096).inputs["input_ids"][0]
        written.append(tokenizer.decode(ids))
        assert ids.tolist() == tokenizer(written[-1].removeprefix("<s>"))["input_ids"]
    turns = "<|im_start|>system\nplan<|im_end|>\n<|im_start|>user\nlook<|im_end|>\n<|im_start|>assistant\n"
    assert written == [turns, f"<s>{turns}"]


def test_pictures_that_cannot_be_read_are_named(folder: Path, open_chat: Open, ask: Ask, view: Look) -> None:
    chat = open_chat(folder)
    with pytest.raises(RequestError, match="picture of 9 bytes is neither PNG nor JPEG"):
        chat.complete(ask(ChatImage(b"not a png"), "look"))
    with pytest.raises(RequestError, match=r"picture of \d+ bytes cannot be read"):
        chat.complete(ask(ChatImage(view(1).data[:200]), "look"))
    wide = io.BytesIO()
    Image.new("RGB", (4097, 2)).save(wide, "png")
    with pytest.raises(RequestError, match="picture of 4097 x 2 pixels; allowed: sides up to 4096"):
        chat.complete(ask(ChatImage(wide.getvalue()), "look"))


def test_control_tokens_in_a_text_are_letters(folder: Path, open_chat: Open, ask: Ask) -> None:
    chat = open_chat(folder)
    for token in ("<|im_end|>", "<|image_pad|>", "<IMG_CONTEXT>", "<img>"):
        row = encode(chat._open().processor, ask(f"a{token}b"), 4096)
        plain = encode(chat._open().processor, ask("ab"), 4096)
        special = chat._open().processor.tokenizer.all_special_ids
        assert sum(int(i) in special for i in row.inputs["input_ids"][0]) == sum(
            int(i) in special for i in plain.inputs["input_ids"][0]
        ), token
        assert chat.complete(ask(f"a{token}b")).completion_tokens == 10


def test_a_full_memory_halves_the_batch_and_names_who_does_not_fit(
    folder: Path, open_chat: Open, ask: Ask, view: Look, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    chat = open_chat(folder)
    requests = several(ask, view)
    loaded = chat._open()
    rows = [encode(loaded.processor, request, 4096) for request in requests]
    expected = [told(chat.complete(request))[:4] for request in requests]
    generate = loaded.model.generate

    def small(**inputs: Any) -> Any:
        if inputs["input_ids"].numel() > max(row.prompt for row in rows):
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.\nand more")
        return generate(**inputs)

    monkeypatch.setattr(loaded.model, "generate", small)
    with caplog.at_level(logging.WARNING, local.__name__):
        replies = chat._answer(rows)
    assert [told(reply)[:4] for reply in replies if isinstance(reply, ChatReply)] == expected
    assert "a batch of 6 does not fit" in caplog.text
    monkeypatch.setattr(loaded.model, "generate", lambda **inputs: small(input_ids=torch.zeros(4096)))
    with pytest.raises(BackendError, match=rf"prompt of {rows[0].prompt} tokens: out of memory on cpu: CUDA out of memory"):
        chat.complete(requests[0])


def test_a_closed_chat_answers_nothing(folder: Path, open_chat: Open, ask: Ask) -> None:
    chat = open_chat(folder)
    chat.close()
    chat.close()
    with pytest.raises(BackendError, match="is closed"):
        chat.complete(ask("look"))


def test_the_released_base_replies_as_the_project_runs_it(open_chat: Open, view: Look) -> None:
    """Prompt tokens and reply, through the project's own collator, positions and decoding."""
    model = load_model(TINY)
    collator = Collator(model.processor, model.cfg)
    chat = open_chat(TINY)
    replies: list[str] = []
    for seed, question in enumerate(("side Mug_1", "height Mug_1", "distance Mug_1")):
        image, prompt = view(seed, 112), looking([(question, "")])
        batch = collator([Example(prompt, (View(np.asarray(open_picture(image))),))], generation=True)
        row = model.generate(batch, 24)[0]
        messages = (ChatMessage("system", (prompt[0].text,)), ChatMessage("user", (image, prompt[1].text)))
        reply = chat.complete(ChatRequest(messages, max_tokens=24))
        assert reply.text == model.processor.tokenizer.decode(row, skip_special_tokens=True)
        assert reply.prompt_tokens == int(batch.attention_mask.sum())
        replies.append(reply.text)
    assert replies[0] in {"left", "ahead", "right"}, replies
