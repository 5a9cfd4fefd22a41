import dataclasses

import numpy as np
import pytest

from data.interface.observation import HistoryItem, Observation, Proprioception
from proprio_mllm.model.batch import Example
from proprio_mllm.model.chat import Encoded
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.model.observing import plan_example
from proprio_mllm.model.prompts import filled_motion, made_motion
from proprio_mllm.model.vocabulary import MOTION_END, MOTION_START, motion_text


@pytest.fixture
def observation(examples) -> Observation:
    view = examples[0].views[0]
    motion = np.random.default_rng(0).normal(size=(16, 6)).astype(np.float32)
    body = Proprioception(motion, 20.0, np.zeros(3), view.key_bodies)
    history = (HistoryItem("GoTo(Mug_1)", "GoTo(Mug_1) ok"),)
    return Observation("tidy up", "h1", view.image, view.camera, ("Mug_1",), ("Mug_1", "Pan_1"), body, history, 1, 9)


def test_observation_becomes_prompt_and_view(cfg, build, observation):
    tokenizer = MotionTokenizer(cfg.motion).eval()
    tokenizer.quantizer.inner._codebook.embed.normal_()
    example = plan_example(observation, cfg, tokenizer)
    codes = tokenizer.encode_window(observation.proprioception.motion)
    assert example.messages[-1].text == f"{motion_text(codes)}h1 2/9 tidy up\nsee Mug_1\nknow Pan_1\ndid\nGoTo(Mug_1) ok"
    model, collate = build(cfg)
    batch = collate([example], generation=True)
    assert batch.images.centroids[0] is not None
    assert len(model.generate(batch, 2)) == 1
    taught = plan_example(observation, cfg, tokenizer, "Done()")
    assert taught.messages[:-1] == example.messages
    assert taught.messages[-1].text == "Done()"


def test_proprioception_is_a_switch(cfg, observation):
    off = dataclasses.replace(cfg, proprioception=False)
    assert "motion" not in plan_example(observation, off, None).messages[-1].text
    with pytest.raises(ValueError, match="needs a motion tokenizer"):
        plan_example(observation, cfg, None)


def test_motion_that_is_shown_stands_beside_the_text(cfg, build):
    model, collate = build(dataclasses.replace(cfg, episodes=True))

    def ids(text):
        return model.processor.tokenizer(text, add_special_tokens=False)["input_ids"]

    def where(before, motion, after):
        tokens = [*ids(before), *ids(motion), *ids(after)]
        example = Example(tokens=Encoded(tuple(tokens), (False,) * len(tokens)), start=7)
        return collate([example]).position_ids[:, 0].tolist()

    shown, text = motion_text([3, 1, 4, 1, 5]), "put the mug"
    plain, beside = where(text, "", "Pick(left"), where(text, shown, "Pick(left")
    head, length = len(ids(text)), len(ids(shown))
    for axis in range(3):
        assert beside[axis][:head] + beside[axis][head + length :] == plain[axis]
        assert beside[axis][head : head + length] == list(range(7 + head - length, 7 + head))


def test_motion_that_is_learnt_stands_in_the_text(cfg, build):
    model, collate = build(dataclasses.replace(cfg, episodes=True))
    begin, end = model.processor.tokenizer.convert_tokens_to_ids([MOTION_START, MOTION_END])

    def steps(messages):
        batch = collate([Example(messages)])
        found = (batch.position_ids[0, 0].diff() != 1).nonzero()[:, 0] + 1
        return batch.input_ids[0].tolist(), found.tolist()

    assert steps(made_motion("a wave", [1, 2], cfg.prompt))[1] == []
    tokens, jumps = steps(filled_motion([1, None], [1, 2], cfg.prompt))
    first = tokens.index(begin)
    assert jumps == [first] and tokens.count(begin) == tokens.count(end) == 2, "the motion that is asked about, not the answer"
